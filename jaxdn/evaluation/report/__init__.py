"""The report of a training run or a comparison: ``metrics.json``, and next to it a page that opens from disk."""

from jaxdn.evaluation.report.images import save_png
from jaxdn.evaluation.report.results import ClipResult, Results, Scores, TrainingCurve, mean_scores
from jaxdn.evaluation.report.summary import sentences, text_table
from jaxdn.evaluation.report.write import write_report

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
