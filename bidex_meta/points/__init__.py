"""Point clouds: what a depth camera would see of every row, from points fixed on the surfaces of geoms."""
