"""Arrays of the broad family, each with its own bench: quantiles of errors, coverage, refusals."""
