"""What a training run or a comparison ends with: numbers in ``metrics.json``, a page that opens from disk beside it."""

from jaxdn.report.images import save_png
from jaxdn.report.results import ClipResult, Results, Scores, TrainingCurve, mean_scores
from jaxdn.report.summary import sentences, text_table
from jaxdn.report.write import write_report

__all__ = [
    "ClipResult",
    "Results",
    "Scores",
    "TrainingCurve",
    "mean_scores",
    "save_png",
    "sentences",
    "text_table",
    "write_report",
]
