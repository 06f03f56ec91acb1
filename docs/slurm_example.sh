#!/bin/bash
# A training on two machines with eight GPUs each, for a cluster that may take them back: sbatch docs/slurm_example.sh
#SBATCH --job-name=fillerbuster
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=64
#SBATCH --time=12:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
# SIGTERM to every task two minutes before the time is up: torchrun hands it on, the training saves and ends.
#SBATCH --signal=TERM@120

set -u
preset=${1:-rooms-tiny}
output=${2:-outputs/$preset}   # on a file system that all machines share
host=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)

srun torchrun --nnodes "$SLURM_NNODES" --nproc-per-node 8 \
    --rdzv-backend c10d --rdzv-endpoint "$host:29500" --rdzv-id "$SLURM_JOB_ID" \
    -m method_configs.train "$preset" --output "$output" --precision bfloat16
status=$?

# Ended by the time limit, not by an error: the same job again, which goes on from the checkpoint. (Preempted jobs are
# queued again by Slurm itself.)
if [ "$status" -ne 0 ] && [ "$SECONDS" -ge $((12 * 3600 - 300)) ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$status"
