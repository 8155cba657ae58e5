"""What every model stands on: named signals, state-space models, solvers, results, files."""
