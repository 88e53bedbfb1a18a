"""The task classes, a module for each kind; ``registry`` maps class names to modules."""
