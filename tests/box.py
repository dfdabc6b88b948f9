"""A mailbox of the bus without a bus, and the publisher to it."""

from __future__ import annotations

import json
from collections import deque
from typing import Any


class Box:
    def __init__(self, *waiting: bytes) -> None:
        self.waiting = deque(waiting)

    def put(self, data: bytes) -> None:
        self.waiting.append(data)

    def put_json(self, value: Any) -> None:
        self.put(json.dumps(value).encode())

    def take(self) -> bytes | None:
        return self.waiting.popleft() if self.waiting else None
