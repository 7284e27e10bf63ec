"""A process that computes on one further device: ``python -m qs3.training.worker RANK FOLDER``."""

import os
import signal
import sys
import threading
from pathlib import Path


def main() -> int:
    """Do the job that lies in the folder, with the processes that meet there."""
    rank, folder = int(sys.argv[1]), Path(sys.argv[2])
    # Ctrl-C reaches every process of a terminal: the first decides, and ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_first, daemon=True).start()
    from qs3.errors import QS3Error
    from qs3.training.deadline import TimeUpError
    from qs3.training.distributed import READY, join, threads
    from qs3.training.job import read_job, run_job

    try:
        job = read_job(folder)
        (folder / f"{READY}-{rank}").touch()
        with threads(job.settings), join(job.settings, rank, folder) as fabric:
            run_job(job, fabric)
    except TimeUpError:
        return 0
    except QS3Error as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


def _end_with_the_first() -> None:
    # Not through sys.stdin: its lock, held here, would abort an interpreter that ends.
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
