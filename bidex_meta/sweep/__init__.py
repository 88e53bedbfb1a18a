"""Many runs from one file: what they are, how far each has come, who runs them."""
