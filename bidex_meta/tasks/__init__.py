"""The task classes, a module for each kind; ``registry`` says which module holds a class."""
