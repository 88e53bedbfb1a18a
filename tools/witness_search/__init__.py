"""Search for witnesses, that is, sequences of actions that solve a task.

Planners find witnesses by maximising the class's reward. Other witnesses come from playing the class's script.
"""
