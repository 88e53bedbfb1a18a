"""Objects from the package or from users' MJCF files, which replace the usual objects of task classes."""
