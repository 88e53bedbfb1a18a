"""Point clouds: what a depth camera would see of every environment, from points fixed on the surfaces of geoms."""
