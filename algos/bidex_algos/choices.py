"""The words that a learner's config may use; imports no torch."""

from typing import Literal

Activation = Literal["elu", "relu", "tanh"]
"""Non-linearity of hidden layers."""

Autocast = Literal["auto", "on", "off"]
"""Whether hidden layers run in bfloat16; see :mod:`bidex_algos.nets.precision`."""

Architecture = Literal["shared", "multi_head", "soft_modules", "paco", "moore"]
"""How networks share weights between tasks; see :mod:`bidex_algos.nets.multitask`."""

Balancing = Literal["none", "pcgrad", "cagrad", "famo"]
"""What is done where tasks pull shared weights apart; see :mod:`bidex_algos.gradients.balancing`."""

Adapted = Literal["all", "head"]
"""Which parameters an adaptation step moves: all, or those of the mean's output layer."""

StepSizeKind = Literal["fixed", "layer", "weight"]
"""Whether sizes of the adaptation step are learned, and of what; see :mod:`bidex_algos.meta.step_sizes`."""
