"""Simulate only the effects a scene calls for: what it has, what that takes, and what may be left out.

``inspect`` finds the effects of a scene or a finished clip, ``plan`` intersects them with what a denoiser reads, and
the renderer obeys the plan. What is left out is ``None`` in a :class:`jaxdn.Frame`, and leaves no trace in the compiled
step: that is equal to its neutral value, at a lower cost.
"""

from jaxdn.effects.catalogue import EFFECTS as EFFECTS
from jaxdn.effects.catalogue import Effect as Effect
from jaxdn.effects.facts import Facts as Facts
from jaxdn.effects.facts import Light as Light
from jaxdn.effects.facts import Moment as Moment
from jaxdn.effects.facts import Surface as Surface
from jaxdn.effects.inspection import Effects as Effects
from jaxdn.effects.inspection import chosen as chosen
from jaxdn.effects.inspection import everything as everything
from jaxdn.effects.inspection import find as find
from jaxdn.effects.inspection import inspect as inspect
from jaxdn.effects.planning import BOUND as BOUND
from jaxdn.effects.planning import Plan as Plan
from jaxdn.effects.planning import plan as plan
from jaxdn.effects.planning import plan_from_record as plan_from_record
