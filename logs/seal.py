"""Seals: signatures, about one each second, over every byte of the file so far.

A seal is a metadata record `seal.000001`, `seal.000002`, ... with the SHA-256 of all bytes before it, signed with
Ed25519. Whoever changes, removes or reorders bytes would have to sign anew, and has not the key. What a chain of seals
cannot show is that the end was cut off: therefore the last seal says that it is the last, and a detached signature over
the whole file, `FILE.mcap.sig`, is made when the file is closed. Keep a copy of that one elsewhere.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from logs.mcap_scan import CorruptLog, LogError

PREFIX = "seal."
PUBLIC_KEY = "public_key"  # in the session's metadata: raw Ed25519 key, hex
SESSION_ID = "session_id"
KEY_FILE = Path("asc") / "log.key"  # below the user's state directory


class KeyFileError(Exception):
    """A key that cannot be used. `hint` tells what to do, in one line."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


# --- keys ------------------------------------------------------------------------------------------------------------


def default_key_file() -> Path:
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / KEY_FILE


def load_key(path: Path | None = None) -> Ed25519PrivateKey:
    """The key in `path`, which others must not be able to read; without a path the user's own, made at first use.

    KeyFileError.
    """
    if path is None:
        path = default_key_file()
        _make_once(path)
    try:
        if os.stat(path).st_mode & 0o077:
            raise KeyFileError(f"{path}: others can read this key", f"chmod 600 {path}; if in doubt make a new one")
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except OSError as error:
        raise KeyFileError(f"{path}: {error.strerror}", "[log] key must be a file of this user") from error
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise KeyFileError(f"{path}: not a key", _MAKE) from error
    if not isinstance(key, Ed25519PrivateKey):
        raise KeyFileError(f"{path}: not an Ed25519 key", _MAKE)
    return key


_MAKE = "make one with: openssl genpkey -algorithm ed25519 -out FILE"


def _make_once(path: Path) -> None:
    """Private key with mode 600, and `.pub` beside it. Two processes may try at once: the first one wins."""
    if path.exists():
        return
    key = Ed25519PrivateKey.generate()
    pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    made = path.with_suffix(f".{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        made.touch(0o600)
        made.write_bytes(pem)
        try:
            os.link(made, path)  # whole or not at all
        except FileExistsError:
            return
        finally:
            made.unlink()
        path.with_name(path.name + ".pub").write_bytes(public_pem(key.public_key()))
    except OSError as error:
        raise KeyFileError(f"{path}: no key can be made: {error.strerror}", "set [log] key to a key file") from error


def load_public_key(path: Path) -> Ed25519PublicKey:
    """KeyFileError."""
    try:
        key = serialization.load_pem_public_key(path.read_bytes())
    except OSError as error:
        raise KeyFileError(f"{path}: {error.strerror}", "give the .pub file of the recording machine") from error
    except (ValueError, UnsupportedAlgorithm) as error:
        raise KeyFileError(f"{path}: not a public key (PEM)", "give the .pub file of the recording machine") from error
    if not isinstance(key, Ed25519PublicKey):
        raise KeyFileError(f"{path}: not an Ed25519 key", "give the .pub file of the recording machine")
    return key


def public_pem(key: Ed25519PublicKey) -> bytes:
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


def raw_hex(key: Ed25519PublicKey) -> str:
    return key.public_bytes_raw().hex()


def key_id(public_hex: str) -> str:
    """Short name of a public key."""
    return hashlib.sha256(bytes.fromhex(public_hex)).hexdigest()[:16]


# --- making ----------------------------------------------------------------------------------------------------------


@dataclass
class Sealer:
    """Makes the seals of one file."""

    key: Ed25519PrivateKey
    session: str  # id of the session, so that a seal cannot be moved to another file
    count: int = 0

    def seal(self, offset: int, sha256: str, final: bool = False) -> tuple[str, dict[str, str]]:
        """Name and content of the metadata record that covers the `offset` bytes before it."""
        self.count += 1
        fields = {
            "session": self.session, "seq": str(self.count), "offset": str(offset), "sha256": sha256,
            "time": str(time.time_ns()), "final": str(final).lower(),
        }  # fmt: skip
        signed = {"signature": self.key.sign(_message(fields)).hex(), "key_id": key_id(raw_hex(self.key.public_key()))}
        return f"{PREFIX}{self.count:06d}", {**fields, **signed}


_FIELDS = ("session", "seq", "offset", "sha256", "time", "final")


def _message(fields: dict[str, str]) -> bytes:
    return "\n".join(["asc seal 1", *(fields[name] for name in _FIELDS)]).encode()


# --- checking --------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Seals:
    """The seals of a file, checked while it is read from its beginning."""

    name: str
    public_key: str = ""  # hex; "": the session was not sealed
    session: str = ""
    count: int = 0
    sealed_bytes: int = 0  # covered by the newest seal
    time_ns: int = 0  # wall clock of the newest seal
    final: bool = False
    _key: Ed25519PublicKey | None = None

    def begin(self, session: dict[str, str]) -> None:
        """The session's metadata tell the key."""
        self.public_key, self.session = session.get(PUBLIC_KEY, ""), session.get(SESSION_ID, "")
        if self.public_key:
            try:
                self._key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(self.public_key))
            except ValueError as error:
                raise CorruptLog(f"{self.name}: damaged: its public key is none") from error

    def check(self, fields: dict[str, str], at: int, sha256: str) -> None:
        """A seal found at byte `at`, before which the file has this hash. CorruptLog: they do not belong together."""
        broken = f"{self.name}: altered: seal {self.count + 1} at byte {at} does not hold; the last good one covers "
        broken += f"bytes 0 to {self.sealed_bytes}"
        if self._key is None or self.final or any(name not in fields for name in (*_FIELDS, "signature")):
            raise CorruptLog(broken)
        told = tuple(fields[name] for name in ("session", "seq", "offset", "sha256"))
        if told != (self.session, str(self.count + 1), str(at), sha256):
            raise CorruptLog(broken)
        try:
            self._key.verify(bytes.fromhex(fields["signature"]), _message(fields))
            self.time_ns = int(fields["time"])
        except (InvalidSignature, ValueError) as error:
            raise CorruptLog(broken) from error
        self.count, self.sealed_bytes, self.final = self.count + 1, at, fields["final"] == "true"

    def finish(self, closed: bool, recovered: bool) -> None:
        """CorruptLog: the logger closed the file, but its last seal is not there."""
        if self.public_key and closed and not recovered and not self.final:
            raise CorruptLog(f"{self.name}: altered: seals are missing after byte {self.sealed_bytes}")


# --- the detached signature ------------------------------------------------------------------------------------------


def signature_path(path: Path) -> Path:
    return path.with_name(path.name + ".sig")


def sign_file(path: Path, key: Ed25519PrivateKey, session: str, size: int, sha256: str) -> None:
    """Write `FILE.sig`: JSON with the hash of the whole file and the signature over it."""
    found = {
        "file": path.name, "session": session, "bytes": str(size), "sha256": sha256, "time": str(time.time_ns()),
        PUBLIC_KEY: raw_hex(key.public_key()),
    }  # fmt: skip
    found["signature"] = key.sign(_detached(found)).hex()
    signature_path(path).write_text(json.dumps(found, indent=1) + "\n")


def check_file(path: Path, public_hex: str) -> bool | None:
    """Does `FILE.sig` hold for the whole file and this key? None: there is none. LogError: it cannot be read."""
    path = path.resolve()  # a link such as latest.mcap has no signature of its own
    try:
        found = json.loads(signature_path(path).read_text())
        with open(path, "rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(public_hex))
        key.verify(bytes.fromhex(found["signature"]), _detached(found))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LogError(f"{signature_path(path)}: cannot be read: {error.strerror}") from error
    except (InvalidSignature, ValueError, KeyError, TypeError, AttributeError):
        return False
    return bool(found["sha256"] == sha256)


def _detached(found: dict[str, str]) -> bytes:
    return "\n".join(["asc file 1", *(found[name] for name in ("session", "bytes", "sha256", "time"))]).encode()
