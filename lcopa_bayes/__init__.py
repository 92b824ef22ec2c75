"""Posteriors for systems with memory, delay and coupled axes, and what the data cannot say."""
