"""A policy at work, live: on a screen in MuJoCo's own viewer, without one in the browser."""
