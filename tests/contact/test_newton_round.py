"""Iteration of Newton's method over worlds with prescribed outcomes."""

from __future__ import annotations

from egs_warp.contact.newton_round import run_round
from egs_warp.kernels.contact.newton_convergence import ACCEPTED, ENDED, FAILED, NEAR_END, NEEDS_TANGENT, SHORTEN


class ScriptedWorlds:
    """Worlds whose trials have prescribed outcomes; points are added in the worlds ``penetrating``."""

    def __init__(self, outcomes: list[list[int]], penetrating: set[int]) -> None:
        self._left, self._penetrating = [list(each) for each in outcomes], penetrating
        self._last, self._active = [0] * len(outcomes), set(range(len(outcomes)))
        self.calls: list[tuple[str, list[int]]] = []

    def running(self) -> list[int]:
        return [world for world in sorted(self._active) if self._left[world]]

    def active(self, bits: int) -> list[int]:
        return [world for world in sorted(self._active) if self._last[world] & bits]

    def _judge(self, name: str, worlds: list[int]) -> None:
        self.calls.append((name, worlds))
        for world in worlds:
            self._last[world] = self._left[world].pop(0)

    def take_step(self, worlds: list[int]) -> None:
        self._judge("step", worlds)

    def halve_step(self, worlds: list[int]) -> None:
        self._judge("halve", worlds)

    def stop(self, bits: int) -> None:
        self._active -= set(self.active(bits))

    def check_penetration(self, worlds: list[int]) -> None:
        self.calls.append(("check", worlds))
        self._active -= set(worlds) & self._penetrating

    def renew_tangent(self, worlds: list[int]) -> None:
        self.calls.append(("renew", worlds))


def test_each_world_halves_renews_and_ends_by_its_own_outcomes() -> None:
    """World 0 halves its step twice, updates its tangent and converges; world 1 fails; world 2 stops because points
    penetrate, while its tangent update is pending; world 3 has no such points, continues and reaches the step limit."""
    near = ACCEPTED | NEAR_END
    worlds = ScriptedWorlds(
        [
            [SHORTEN, SHORTEN, ACCEPTED | NEEDS_TANGENT, ACCEPTED | ENDED | NEAR_END],
            [FAILED | NEEDS_TANGENT, ACCEPTED],
            [near | NEEDS_TANGENT, ACCEPTED],
            [near, ACCEPTED],
        ],
        penetrating={2},
    )
    run_round(worlds)
    assert worlds.calls == [
        ("step", [0, 1, 2, 3]),
        ("halve", [0]),
        ("halve", [0]),
        ("check", [2, 3]),
        ("renew", [0]),
        ("step", [0, 3]),
    ]
