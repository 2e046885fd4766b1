"""Simulate only the effects a scene calls for: what it has, what that takes, and what may be left out.

``inspect`` finds the effects of a scene or a finished clip, ``plan`` intersects them with what a denoiser reads, and
the renderer obeys the plan. What is left out is ``None`` in a :class:`jaxdn.Frame`, and leaves no trace in the compiled
step: that is equal to its neutral value, at a lower cost.
"""

from jaxdn.planning.catalogue import EFFECTS as EFFECTS
from jaxdn.planning.catalogue import Effect as Effect
from jaxdn.planning.facts import Facts as Facts
from jaxdn.planning.facts import Light as Light
from jaxdn.planning.facts import Moment as Moment
from jaxdn.planning.facts import Surface as Surface
from jaxdn.planning.found import Effects as Effects
from jaxdn.planning.found import chosen as chosen
from jaxdn.planning.found import everything as everything
from jaxdn.planning.found import find as find
from jaxdn.planning.found import inspect as inspect
from jaxdn.planning.plan import BOUND as BOUND
from jaxdn.planning.plan import Plan as Plan
from jaxdn.planning.plan import plan as plan
from jaxdn.planning.plan import plan_from_record as plan_from_record
