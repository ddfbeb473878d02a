"""What the kernels in C do, in NumPy: the formulas that they are compared with."""
