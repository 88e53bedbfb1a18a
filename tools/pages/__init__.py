"""Generate the tables and pictures of README.md, docs/pretrained.md and docs/results from results/data."""
