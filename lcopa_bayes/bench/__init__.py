"""The virtual bench: synthetic records by numerics that share no code with the forward model."""
