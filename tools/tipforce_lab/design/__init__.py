"""The structure: the paper's tables and figures, other designs, and error budgets."""
