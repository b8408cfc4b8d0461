"""Localisation of photos on the workers of a Dask cluster; needs the extra `cluster`."""

import asyncio
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import islice

from distributed import Client, Future, LocalCluster, WorkerPlugin, as_completed, get_worker
from distributed.comm import connect

from bpnp.maps.many_photos import Attempt, PhotoTask, attempt
from bpnp.maps.scene_map import SceneMap
from bpnp.search.solution import Solution

QUEUED_PHOTOS = 4  # photos per worker thread on a cluster: no thread waits, and the scheduler holds few [photos; cost]
SCHEDULER_SECONDS = 10  # time until a Dask scheduler must answer [seconds; convention]


class MapOfWorker(WorkerPlugin):
    """Worker plugin that holds the map; Dask sends it once to each worker, also to one that joins later."""

    def __init__(self, scene: SceneMap) -> None:
        self.scene, self.name = scene, f"bpnp-{uuid.uuid4().hex}"


def attempts_on_cluster(scene: SceneMap, tasks: Iterable[PhotoTask], cluster: str) -> Iterator[Attempt]:
    """Yield the results of photos in the order in which they finish.

    `cluster` is the address of a scheduler, such as tcp://10.0.0.1:8786, or the number of processes to start on this
    machine; raise ValueError without a scheduler there. The workers need bpnp, and photos and keypoints under the same
    paths as here. If a worker is lost, its photos are reassigned.
    """
    plugin = MapOfWorker(scene)
    with connect_client(cluster) as client:
        client.register_plugin(plugin)
        running: dict[object, PhotoTask] = {}

        def submit() -> Iterator[Future]:
            for task in tasks:
                future = client.submit(_attempt, plugin.name, task, pure=False)
                running[future.key] = task
                yield future

        try:
            waiting = submit()
            done = as_completed(islice(waiting, QUEUED_PHOTOS * max(sum(client.nthreads().values()), 1)))
            for future in done:
                task = running.pop(future.key)
                yield task, str(future.exception()) if future.status == "error" else future.result()
                done.update(islice(waiting, 1))
        finally:  # a run that is stopped leaves no map on the workers
            if client.status == "running":
                client.unregister_worker_plugin(plugin.name)


@contextmanager
def connect_client(cluster: str) -> Iterator[Client]:
    """Yield a client of the scheduler at an address, or of a given number of new single-threaded processes."""
    if cluster.isdecimal():
        if int(cluster) < 1:
            raise ValueError(
                f"--cluster is {cluster}; it must be at least one process, or the address of a Dask scheduler"
            )
        processes = LocalCluster(n_workers=int(cluster), threads_per_worker=1, dashboard_address=None)
        with processes, Client(processes) as client:
            yield client
        return
    try:  # first: a client that fails to connect leaves threads that wait for each other
        asyncio.run(_answers(cluster))
    except (OSError, ValueError) as error:
        raise ValueError(
            f"--cluster is {cluster}, not a number of processes, and no Dask scheduler answers there: {error}"
        ) from error
    with Client(cluster, timeout=SCHEDULER_SECONDS) as client:
        yield client


async def _answers(address: str) -> None:
    """Raise OSError or ValueError if no scheduler answers."""
    comm = await connect(address, timeout=SCHEDULER_SECONDS)
    await comm.close()


def _attempt(plugin: str, task: PhotoTask) -> Solution | str:
    holder = get_worker().plugins[plugin]
    assert isinstance(holder, MapOfWorker)
    return attempt(holder.scene, task)
