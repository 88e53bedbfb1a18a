"""Tables and pictures that README.md and docs/results make of results/data."""
