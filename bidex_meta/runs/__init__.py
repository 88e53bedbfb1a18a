"""Everything that writes to disk: the run folder, checkpoints, metrics, curves, pictures and films.

Importing this package is cheap; torch, TensorBoard, matplotlib and imageio are loaded by the function that needs them.
"""

from bidex_meta.runs.checkpoints import Checkpoints
from bidex_meta.runs.folder import RunFolder
from bidex_meta.runs.metrics import MetricsWriter, mend, read_metrics, training_seconds
from bidex_meta.runs.progress import Progress
from bidex_meta.runs.recorder import Recorder

__all__ = [
    "Checkpoints",
    "MetricsWriter",
    "Progress",
    "Recorder",
    "RunFolder",
    "mend",
    "read_metrics",
    "training_seconds",
]
