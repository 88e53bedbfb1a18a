"""Live views of a policy: in MuJoCo's viewer on a screen, or in a browser if there is no screen."""
