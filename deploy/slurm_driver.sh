#!/bin/bash
# The driver as a job of its own: sbatch deploy/slurm_driver.sh SPEC STORE. It may be stopped,
# preempted and requeued at any time. Each start is the same command: it begins, goes on, or finds
# that all is done.
#SBATCH --job-name=sweep
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --time=1-00:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:TERM@300

sweep run "$1" --store "$2" --resume --cluster deploy/slurm.yaml &
driver=$!
stopped=
trap 'stopped=yes; kill -TERM $driver' TERM   # sweep finishes what runs, and ends with code 3
wait $driver
code=$?
if [ -n "$stopped" ]; then
    wait $driver
    code=$?
    [ $code = 3 ] && scontrol requeue "$SLURM_JOB_ID"
fi
exit $code
