"""What Ta et al. 2026 do with a record, done as they describe it."""
