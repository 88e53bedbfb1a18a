"""A policy live: in MuJoCo's viewer on a screen, in the browser without one."""
