"""How good a policy is: episodes, results, the meta-test and its control, scores, runs beside each other."""
