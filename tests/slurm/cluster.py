"""A real Slurm on this machine alone, for as long as this process lasts: `python tests/slurm/cluster.py FOLDER`.

Debian's slurmctld and slurmd run without systemd, cgroups, munge and database, on 127.0.0.1, with everything that they
write in FOLDER. Two partitions share four processors that need not exist; jobs of `high` preempt and requeue those of
`low`. Nothing is authenticated: this is for tests, on a machine where nobody else is.

Prints the line that a shell needs to use it, and ends everything on SIGINT or SIGTERM.
"""

import getpass
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

# Times are short: a requeued job may start again after cred_expire seconds, one that has been told to end is killed
# after KillWait. Limits of time Slurm checks every 30 seconds, which no setting changes.
CONFIG = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={daemon}
SlurmUser={user}
SlurmdUser={user}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
AuthType=auth/none
AuthInfo=cred_expire=5
CredType=cred/none
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
ReturnToService=2
MinJobAge=86400
KillWait=2
SchedulerType=sched/backfill
SchedulerParameters=bf_interval=1,sched_interval=1,batch_sched_delay=1
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
PreemptExemptTime=0
SlurmctldParameters=preempt_send_user_signal
SlurmdParameters=config_overrides
NodeName={host} NodeAddr=127.0.0.1 CPUs=4 RealMemory=16000
PartitionName=low Nodes={host} Default=YES PriorityTier=1 GraceTime=60
PartitionName=high Nodes={host} PriorityTier=2
"""

# What submitit asks sacct for, which needs a database: without an answer it would wait for a dead job for ever.
SACCT = """\
#!/bin/sh
echo 'JobID|State|NodeList'
scontrol show job -o | sed -nE \\
    -e 's/^JobId=([0-9]+) ArrayJobId=([0-9]+) ArrayTaskId=([0-9]+) .*JobState=(\\S+) .*/\\2_\\3|\\4|/p;t' \\
    -e 's/^JobId=([0-9]+) ArrayJobId=([0-9]+) ArrayTaskId=(\\S+) .*JobState=(\\S+) .*/\\2_[\\3]|\\4|/p;t' \\
    -e 's/^JobId=([0-9]+) .*JobState=(\\S+) .*/\\1|\\2|/p'
"""


def main(folder: Path) -> None:
    """Run the cluster until a signal ends it. Raises: SystemExit, if it does not answer."""
    for name in ("state", "spool", "bin"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    with ExitStack() as sockets:
        free = [sockets.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        controller, daemon = (each.getsockname()[1] for each in free)
    user = getpass.getuser()
    (folder / "slurm.conf").write_text(
        CONFIG.format(
            host=socket.gethostname().split(".")[0],
            controller=controller,
            daemon=daemon,
            user=user,
            folder=folder,
        )
    )
    (folder / "bin" / "sacct").write_text(SACCT)
    (folder / "bin" / "sacct").chmod(0o755)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: sys.exit())
    environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
    daemons: list[subprocess.Popen[bytes]] = []

    def ask(*command: str) -> str:
        return subprocess.run(command, env=environment, capture_output=True, text=True).stdout

    def wait_for(condition: Callable[[], bool]) -> None:
        patience = time.monotonic() + 60
        while not condition():
            if time.monotonic() > patience or any(each.poll() is not None for each in daemons):
                sys.exit(f"Slurm does not answer: see {folder}/slurmctld.log and {folder}/slurmd.log")
            time.sleep(0.2)

    try:
        for command in (("slurmctld", "-D", "-i"), ("slurmd", "-D")):
            daemons.append(subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL))
        wait_for(lambda: "idle" in ask("sinfo", "--noheader", "--format=%T"))
        print(f"export SLURM_CONF={folder}/slurm.conf PATH={folder}/bin:$PATH", flush=True)
        signal.pause()
    finally:
        if len(daemons) == 2:  # whose jobs would outlive them
            ask("scancel", f"--user={user}")
            wait_for(lambda: not ask("squeue", "--noheader"))
        for each in reversed(daemons):
            each.terminate()
            each.wait()


if __name__ == "__main__":
    if missing := [name for name in ("slurmctld", "slurmd", "sbatch") if shutil.which(name) is None]:
        sys.exit(f"no {', '.join(missing)}: apt-get install slurmctld slurmd slurm-client")
    main(Path(sys.argv[1]).absolute())
