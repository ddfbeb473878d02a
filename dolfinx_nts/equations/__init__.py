"""The equations of one step: unknowns, residual, and the only PETSc matrices."""
