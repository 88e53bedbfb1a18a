"""Task classes, one module per kind of task; ``registry`` finds a class by its name."""
