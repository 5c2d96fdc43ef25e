"""Design studies: the paper's tables and figures, the error budget, the search for better structures."""
