"""Generate the tables and pictures of README.md and docs/results from results/data."""
