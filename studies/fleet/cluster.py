"""What a device of a fleet costs on a Dask cluster, and what more workers gain.

    python studies/fleet/cluster.py [--devices N] [--workers N ...]

Makes a fleet (`make.py`) and fits it on clusters of processes of this machine, one after the other. Where it
has fewer cores than a cluster has workers, the CPU time of the busiest worker is what the fleet would take
with a core for each; work done twice, what is sent, and devices shared out unevenly are part of it.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

from distributed import Client, LocalCluster
from distributed.protocol.pickle import dumps
from make import make

import lcopa_bayes as lb


def stored(folder: Path) -> int:
    """Bytes of the files in a folder."""
    return sum(one.stat().st_size for one in folder.rglob("*") if one.is_file())


def main() -> None:
    """Print one line per cluster."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--devices", type=int, default=40)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 4])
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        make(Path(place) / "devices", given.devices, 1)
        study = lb.load_study(Path(place) / "devices" / "device-001")
        sent = len(dumps((study.name, study)))
        print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; a device is sent as {sent} bytes")
        tables, busiest = [], []
        for count in given.workers:
            out = Path(place) / f"out-{count}"
            with LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=":0") as cluster:
                address = cluster.scheduler_address
                with Client(address) as client:
                    client.run(__import__, "lcopa_bayes.verbs.fleet")  # no import is measured
                    begun = client.run(time.process_time)
                    began, own = time.monotonic(), time.process_time()
                    result = lb.fleet(Path(place) / "devices", dask=address, folder=out)
                    wall, own = time.monotonic() - began, time.process_time() - own
                    spent = [now - begun[one] for one, now in client.run(time.process_time).items()]
            tables.append({key: one for key, one in result.to_json().items() if key != "seconds"})
            each = stored(out / "devices") / given.devices
            busiest.append(max(spent))
            print(
                f"{count} workers: {wall:.1f} s, {sum(spent) / given.devices:.2f} CPU seconds per device on "
                f"the workers and {own / given.devices:.3f} here, {each:.0f} bytes stored per device; the "
                f"busiest worker {max(spent):.1f} CPU seconds, {busiest[0] / max(spent):.2f} times fewer "
                f"than of {given.workers[0]}",
                flush=True,
            )
        print("equal tables" if all(one == tables[0] for one in tables) else "tables differ")


if __name__ == "__main__":
    main()
