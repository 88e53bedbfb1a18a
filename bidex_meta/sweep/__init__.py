"""Many runs from one file: which they are, and the queue that runs them."""
