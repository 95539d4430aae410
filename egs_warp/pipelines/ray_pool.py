"""Worker pool on Ray, on this machine or on the hosts of a cluster; Ray is an optional extra."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
from collections.abc import Sequence
from types import ModuleType
from typing import Any

from egs_warp.errors import ArgumentError, UserError
from egs_warp.installation import install_command
from egs_warp.pipelines.worker_pool import ONE_THREAD, Event, TaskFunction, attempt

DEFAULT_ADDRESS = "ray"
"""Address that selects the connected Ray cluster if there is one, otherwise the cluster at ``RAY_ADDRESS``, or else a
temporary one."""
_POLL_INTERVAL = 0.5
"""Interval at which the progress of the workers is read, s."""


class RayWorker:
    """Ray actor that runs tasks; ``take_messages`` can be called while ``run`` is running."""

    def __init__(self, work: bytes) -> None:
        # Set these variables before any library reads them: Ray sets OMP_NUM_THREADS to the number of cores of the
        # worker.
        os.environ.update(ONE_THREAD)
        self._work = pickle.loads(work)
        self._messages: list[tuple[Any, ...]] = []

    def run(self, task: Any) -> bytes:
        """Run ``task`` and return its pickled result (``attempt``)."""
        self._messages = []
        return attempt(self._work, task, lambda *values: self._messages.append(values))

    def take_messages(self) -> list[tuple[Any, ...]]:
        """Return the progress messages of the task since the last call."""
        messages, self._messages = self._messages, []
        return messages


class RayPool:
    """Worker pool on a Ray cluster, with one core per worker. A Ray instance that the pool has started ends with the
    pool."""

    def __init__(self, work: TaskFunction, max_workers: int, address: str = DEFAULT_ADDRESS) -> None:
        """Connect to Ray.

        Args:
            work: The task function.
            max_workers: Maximum number of workers.
            address: Address of a Ray cluster, or ``DEFAULT_ADDRESS``.

        Raises:
            UserError: Ray is not installed, or does not answer at ``address``.
        """
        self._ray = ray = _imported()
        self._owns_ray = not ray.is_initialized()
        if self._owns_ray:
            ray_address = os.environ.get("RAY_ADDRESS", "local") if address == DEFAULT_ADDRESS else address
            options: dict[str, Any] = {"include_dashboard": False} if ray_address == "local" else {}
            try:
                ray.init(ray_address, log_to_driver=False, logging_level=logging.ERROR, **options)
            except (ConnectionError, ValueError, RuntimeError, OSError) as error:
                line = " ".join(str(error).split())
                raise ArgumentError(
                    "workers",
                    f"no Ray cluster answers at this address ({line}); start one (ray start), or check the address",
                    value=address,
                ) from error
        self.size = max(1, min(max_workers, int(ray.cluster_resources().get("CPU", 1))))
        # Allow two concurrent calls: one runs the task, the other reads its progress.
        self._actor_class = ray.remote(num_cpus=1, max_restarts=0, max_concurrency=2)(RayWorker)
        self._work = ray.put(pickle.dumps(work))
        self._actors: dict[int, Any] = {}
        self._running: dict[Any, int] = {}
        self._polls: dict[Any, int] = {}

    def begin(self, worker: int, task: Any) -> None:
        """Assign a task to an idle worker; a worker that does not exist or was lost is started."""
        if worker not in self._actors:
            self._actors[worker] = self._actor_class.remote(self._work)
        actor = self._actors[worker]
        self._running[actor.run.remote(task)] = worker

    def wait(self) -> Sequence[Event]:
        """Block until workers have sent messages or the polling interval has passed; return the messages."""
        ray = self._ray
        pending = [*self._running, *self._polls]
        ready, _ = ray.wait(pending, num_returns=1, timeout=_POLL_INTERVAL)
        events: list[Event] = []
        for call in ready:
            if call in self._polls:
                worker = self._polls.pop(call)
                # Ignore this error: the loss of a worker is reported by the call that runs its task.
                with contextlib.suppress(ray.exceptions.RayError):
                    messages = ray.get(call)
                    events += [Event(worker, "progress", values) for values in messages[-1:]]
                continue
            worker = self._running.pop(call)
            # A finished task reports no more progress.
            self._polls = {poll: other for poll, other in self._polls.items() if other != worker}
            try:
                events.append(Event(worker, *pickle.loads(ray.get(call))))
            except ray.exceptions.RayError as error:
                # Kill the worker: it may be only unreachable, and must not run concurrently with its successor.
                with contextlib.suppress(Exception):
                    ray.kill(self._actors[worker])
                del self._actors[worker]
                events.append(Event(worker, "lost", str(error).strip().partition("\n")[0]))
        if not ready:
            polled = set(self._polls.values())
            free = [worker for worker in self._running.values() if worker not in polled]
            self._polls |= {self._actors[worker].take_messages.remote(): worker for worker in free}
        return events

    def close(self) -> None:
        """Terminate all workers, even busy ones."""
        for actor in self._actors.values():
            with contextlib.suppress(Exception):
                self._ray.kill(actor)
        self._actors.clear()
        if self._owns_ray:
            self._ray.shutdown()


def _imported() -> ModuleType:
    # Disable usage statistics, which a library must not send on behalf of its users.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise UserError(f"workers ray: Ray is not installed; {install_command('ray')}") from error
    return ray
