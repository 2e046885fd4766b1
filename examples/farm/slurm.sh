#!/bin/bash
#SBATCH --array=0-1 --cpus-per-task=4 --mem=8G --requeue
# Frames 1 to 400 in chunks of 200, one for each task of the array: sbatch slurm.sh shots/a denoised/a
INPUT=${1:?folder of noisy EXR files} OUTPUT=${2:?folder of the denoised files}
CHUNK=${CHUNK:-200} FIRST=${FIRST:-1} METHOD=${METHOD:-auto}
BEGIN=$((FIRST + CHUNK * SLURM_ARRAY_TASK_ID))
exec ${JAXDN:-jaxdn} denoise "$INPUT" -o "$OUTPUT" --method "$METHOD" \
  --frames "$BEGIN-$((BEGIN + CHUNK - 1))" --skip-existing
