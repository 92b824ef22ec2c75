"""The public functions: each takes a study or an earlier result and gives a result."""
