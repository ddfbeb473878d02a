"""Arrays in, arrays out, and energies in UFL: nothing here knows ranks or solvers."""
