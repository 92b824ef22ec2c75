"""Draws of a posterior: ensembles, tempering, nested and importance sampling, evidence, convergence."""
