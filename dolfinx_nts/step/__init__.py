"""One step: its unknowns, equations, matrices, solvers, guards and its row of the ledger."""
