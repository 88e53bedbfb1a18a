"""Networks: actors and critics, memories, running statistics, and the agents made of them."""
