"""The validation page of a shot: what its vectors, guides and noise are, measured, and what to do about it."""

from jaxdn.evaluation.overlay.findings import Finding
from jaxdn.evaluation.overlay.shot import Overlay, write_overlay

__all__ = ["Finding", "Overlay", "write_overlay"]
