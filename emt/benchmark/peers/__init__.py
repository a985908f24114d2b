"""Filters of other packages on the scans of the benchmarks: to check that they compute the same, and to time them.

The packages are optional (`pip install emt[peers]`); each is imported when one of its filters is prepared.
"""

from importlib.metadata import PackageNotFoundError, version

from emt.benchmark.peers import with_filterpy, with_pyrecest, with_stonesoup
from emt.benchmark.peers.base import ELLIPSE, POINT, Peer, Scans

__all__ = ["ELLIPSE", "PEERS", "POINT", "Peer", "Scans", "installed"]

PEERS: tuple[Peer, ...] = (*with_pyrecest.PEERS, *with_filterpy.PEERS, *with_stonesoup.PEERS)


def installed(peer: Peer) -> str | None:
    """Version of the package of a peer, or None if it is not installed."""
    try:
        return version(peer.package)
    except PackageNotFoundError:
        return None
