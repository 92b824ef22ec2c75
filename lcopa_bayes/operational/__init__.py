"""Block pulses and the triangular Toeplitz algebra of their fractional integrals."""
