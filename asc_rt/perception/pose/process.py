"""The estimator's own process, which `link` starts: frames come in, limbs go out.

It has neither a network nor a real-time priority, and it ends with perception. A library that hangs, crashes, fills
the memory or tells others what it sees can do so here only.

    in    pickles: (estimator as "module:Class", model, {number: Scene}), then (number, depth, image) again and again
    out   lines of JSON: {"ready": version} or {"refused": [line, ...]}, then for each frame {"limbs": [...]} as
          `limbs.Row`, or {"wrong": what the estimator raised}
"""

from __future__ import annotations

import ctypes
import json
import os
import pickle
import signal
import sys
from typing import Any, BinaryIO

_PR_SET_PDEATHSIG = 1
_CLONE_NEWUSER, _CLONE_NEWNET = 0x10000000, 0x40000000
NICE = 10


def main() -> None:
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    os.nice(NICE)
    # Before a library has started a thread. Who is not root is given a network of their own with users of their own.
    if libc.unshare(_CLONE_NEWNET) and libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET):
        why = os.strerror(ctypes.get_errno())
        allow = "allow user namespaces (sysctl kernel.apparmor_restrict_unprivileged_userns=0 on Ubuntu)"
        _say(out, {"refused": [f"perception.pose: it cannot be kept from the network: {why}; {allow}"]})
        return
    _serve(sys.stdin.buffer, out)


def _serve(source: BinaryIO, out: Any) -> None:
    from asc_rt.perception.pose.limbs import PoseError, found

    target, model, scenes = pickle.load(source)
    try:
        estimator = _load(target)(model)
    except PoseError as error:
        return _say(out, {"refused": list(error.lines)})
    _say(out, {"ready": estimator.version})
    while True:
        try:
            number, depth, image = pickle.load(source)
        except EOFError:
            return None
        try:
            answer: dict[str, Any] = {"limbs": found(depth, image, scenes[number], estimator)}
        except Exception as error:  # a foreign library may raise anything; the next picture is another one
            answer = {"wrong": f"{type(error).__name__}: {error}"}
        _say(out, answer)


def _load(target: str) -> Any:
    from importlib import import_module

    module, _, name = target.partition(":")
    return getattr(import_module(module), name)


def _say(out: Any, told: dict[str, Any]) -> None:
    print(json.dumps(told), file=out, flush=True)


if __name__ == "__main__":
    main()
