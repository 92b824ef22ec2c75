"""What every room rests on: errors, arrays, files, checks, estimates, processes."""
