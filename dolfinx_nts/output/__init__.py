"""Writers of fields and tables, plots and pictures."""

from dolfinx_nts.output.writers import BalanceCSV, Fields, ForcesCSV

__all__ = ["BalanceCSV", "Fields", "ForcesCSV"]
