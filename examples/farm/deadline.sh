#!/bin/bash
# Deadline 10, by its CommandLine plugin: deadline.sh /shots/a /denoised/a 1-400
INPUT=${1:?folder of noisy EXR files} OUTPUT=${2:?folder of the denoised files} FRAMES=${3:?frames, such as 1-400}
exec ${DEADLINE:-deadlinecommand} -SubmitCommandLineJob -executable jaxdn \
  -arguments "denoise <QUOTE>$INPUT<QUOTE> -o <QUOTE>$OUTPUT<QUOTE> --frames <STARTFRAME>-<ENDFRAME> --skip-existing" \
  -frames "$FRAMES" -chunksize "${CHUNK:-200}" -name "denoise $(basename "$INPUT")"
