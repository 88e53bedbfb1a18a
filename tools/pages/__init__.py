"""Results as data: runs condensed to a file of JSON each, and the tables and pictures that pages make of them."""
