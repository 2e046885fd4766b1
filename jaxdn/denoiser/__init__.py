"""What a denoiser is, and what is done with any: valid frames in, one image a frame out, whole clips, tiles."""

from jaxdn.denoiser.interface import Core as Core
from jaxdn.denoiser.interface import Denoiser as Denoiser
from jaxdn.denoiser.interface import Params as Params
from jaxdn.denoiser.interface import Pattern as Pattern
from jaxdn.denoiser.interface import Prepared as Prepared
from jaxdn.denoiser.interface import Recurrent as Recurrent
from jaxdn.denoiser.interface import Stages as Stages
from jaxdn.denoiser.interface import State as State
from jaxdn.denoiser.interface import Step as Step
from jaxdn.denoiser.interface import check_frame as check_frame
from jaxdn.denoiser.interface import core_of as core_of
from jaxdn.denoiser.interface import recurrent as recurrent
from jaxdn.denoiser.interface import stages_of as stages_of
