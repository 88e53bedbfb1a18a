"""What worlds gave: rollouts, a replay, episodes in numbers, advantages."""
