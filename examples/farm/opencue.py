"""OpenCue, by PyOutline: python opencue.py /shots/a /denoised/a 1-400. The tokens are the frames of a chunk."""

import getpass
import shlex
import sys
from pathlib import Path

from outline import Outline, cuerun
from outline.modules.shell import Shell

source, out, frames = sys.argv[1:]
job = Outline(f"denoise-{Path(source).name}", shot=Path(source).name, show="film", user=getpass.getuser())
chunk = "#FRAME_START#-#FRAME_END#"
command = ["jaxdn", "denoise", shlex.quote(source), "-o", shlex.quote(out), "--frames", chunk, "--skip-existing"]
job.add_layer(Shell("denoise", command=command, range=frames, chunk=200, threads=4, memory="8g"))
cuerun.launch(job, use_pycuerun=False)
