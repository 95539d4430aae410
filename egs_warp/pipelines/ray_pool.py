"""Workers that Ray runs, on this machine or on the hosts of a cluster (an optional extra)."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
from collections.abc import Sequence
from types import ModuleType
from typing import Any

from egs_warp.errors import ArgumentError, UserError
from egs_warp.pipelines.worker_pool import ONE_THREAD, Event, TaskFunction, attempt

HERE = "ray"
"""As an address: the Ray that this program is connected to, else that of ``RAY_ADDRESS``, else one for the time."""
_LOOK = 0.5
"""Seconds between looks at how far the workers are."""


class RayWorker:
    """The life of a worker, as an actor; ``seen`` is asked for while ``run`` runs."""

    def __init__(self, work: bytes) -> None:
        # Before anything is loaded that reads it. Ray itself sets OMP_NUM_THREADS to the cores that it gives.
        os.environ.update(ONE_THREAD)
        self._work = pickle.loads(work)
        self._told: list[tuple[Any, ...]] = []

    def run(self, task: Any) -> bytes:
        """What the work makes of ``task``, see ``attempt``."""
        self._told = []
        return attempt(self._work, task, lambda *values: self._told.append(values))

    def seen(self) -> list[tuple[Any, ...]]:
        """What the task has told since this was asked last."""
        told, self._told = self._told, []
        return told


class RayPool:
    """Workers of a Ray cluster, each on one core; a Ray that was started for them ends with them."""

    def __init__(self, work: TaskFunction, most: int, address: str = HERE) -> None:
        """At most so many workers. Raises ``UserError`` where Ray is not installed, or not at the ``address``."""
        self._ray = ray = _imported()
        self._own = not ray.is_initialized()
        if self._own:
            place = os.environ.get("RAY_ADDRESS", "local") if address == HERE else address
            options: dict[str, Any] = {"include_dashboard": False} if place == "local" else {}
            try:
                ray.init(place, log_to_driver=False, logging_level=logging.ERROR, **options)
            except (ConnectionError, ValueError, RuntimeError, OSError) as error:
                line = " ".join(str(error).split())
                raise ArgumentError("workers", f"no Ray answers there ({line})", value=address) from error
        self.size = max(1, min(most, int(ray.cluster_resources().get("CPU", 1))))
        # Two calls at a time: the task's, and that which asks how far it is.
        self._kind = ray.remote(num_cpus=1, max_restarts=0, max_concurrency=2)(RayWorker)
        self._work = ray.put(pickle.dumps(work))
        self._actors: dict[int, Any] = {}
        self._running: dict[Any, int] = {}
        self._looks: dict[Any, int] = {}

    def begin(self, worker: int, task: Any) -> None:
        """See ``Crew``."""
        if worker not in self._actors:
            self._actors[worker] = self._kind.remote(self._work)
        actor = self._actors[worker]
        self._running[actor.run.remote(task)] = worker

    def wait(self) -> Sequence[Event]:
        """See ``Crew``."""
        ray = self._ray
        pending = [*self._running, *self._looks]
        ready, _ = ray.wait(pending, num_returns=1, timeout=_LOOK)
        events: list[Event] = []
        for call in ready:
            if call in self._looks:
                worker = self._looks.pop(call)
                # A worker that is lost is told by its task's call.
                with contextlib.suppress(ray.exceptions.RayError):
                    told = ray.get(call)
                    events += [Event(worker, "told", values) for values in told[-1:]]
                continue
            worker = self._running.pop(call)
            # Of a task that is over nothing more is told.
            self._looks = {look: other for look, other in self._looks.items() if other != worker}
            try:
                events.append(Event(worker, *pickle.loads(ray.get(call))))
            except ray.exceptions.RayError as error:
                # One that only cannot be reached must not go on beside its successor.
                with contextlib.suppress(Exception):
                    ray.kill(self._actors[worker])
                del self._actors[worker]
                events.append(Event(worker, "lost", str(error).strip().partition("\n")[0]))
        if not ready:
            asked = set(self._looks.values())
            free = [worker for worker in self._running.values() if worker not in asked]
            self._looks |= {self._actors[worker].seen.remote(): worker for worker in free}
        return events

    def close(self) -> None:
        """See ``Crew``."""
        for actor in self._actors.values():
            with contextlib.suppress(Exception):
                self._ray.kill(actor)
        self._actors.clear()
        if self._own:
            self._ray.shutdown()


def _imported() -> ModuleType:
    # A library does not call home for others.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise UserError("workers ray: Ray is not installed; pip install 'egs-warp[ray]'") from error
    return ray
