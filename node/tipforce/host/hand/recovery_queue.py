"""Run the recoveries of fingers in parallel, and repeat those that fail."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor

RETRY_S = 0.5
_SIDE_BY_SIDE = 8


class RecoveryQueue:
    """Run ``recover(node_id)`` for fingers that need recovery, in parallel; retry after RETRY_S until it returns True.

    A finger that needs another recovery during one gets it immediately afterwards.
    """

    def __init__(self, recover: Callable[[int], bool]) -> None:
        self._recover = recover
        self._pool = ThreadPoolExecutor(_SIDE_BY_SIDE, thread_name_prefix="recovery")
        self._lock = threading.Lock()
        self._busy: set[int] = set()
        self._due_s: dict[int, float] = {}
        self._quiet: set[int] = set()

    def need(self, node_ids: Collection[int], *, quiet: bool = False) -> None:
        """Request the recovery of these fingers now; ``quiet``: something to read, which ``waiting`` does not count."""
        with self._lock:
            if quiet:
                self._quiet |= set(node_ids) - self._due_s.keys() - self._busy
            else:
                self._quiet -= set(node_ids)
            self._due_s |= dict.fromkeys(node_ids, 0.0)
        self.tick()

    def drop(self, node_id: int) -> None:
        """Stop retries for a finger that is lost: recovery is impossible until it sends again."""
        with self._lock:
            self._due_s.pop(node_id, None)

    def waiting(self) -> bool:
        """Return whether a recovery is active or pending."""
        with self._lock:
            return bool((self._busy | self._due_s.keys()) - self._quiet)

    def tick(self) -> None:
        """Start the recoveries that are due; call it regularly."""
        now_s = time.monotonic()
        with self._lock:
            due = [n for n, due_s in self._due_s.items() if due_s <= now_s and n not in self._busy]
            for node_id in due:
                del self._due_s[node_id]
                self._busy.add(node_id)
        for node_id in due:
            self._pool.submit(self._run, node_id)

    def close(self) -> None:
        """Start no more recoveries and wait for the active ones."""
        with self._lock:
            self._due_s.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _run(self, node_id: int) -> None:
        recovered = False
        try:
            recovered = self._recover(node_id)
        finally:
            with self._lock:
                self._busy.discard(node_id)
                if recovered and node_id not in self._due_s:
                    self._quiet.discard(node_id)
                if not recovered:
                    self._due_s.setdefault(node_id, time.monotonic() + RETRY_S)
