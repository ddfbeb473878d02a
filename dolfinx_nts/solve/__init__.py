"""How the equations of a step are solved: Newton, linear solvers, convergence, failures."""
