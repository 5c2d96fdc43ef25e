"""The cases, one file per service; ``case.all_cases`` finds them."""
