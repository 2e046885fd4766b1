"""Filters of diffuse and specular light apart: ``relax`` and ``reblur``, and what they share."""

from jaxdn.methods.two_lobes import reblur as reblur
from jaxdn.methods.two_lobes import relax as relax
