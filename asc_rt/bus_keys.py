"""Certificates for a cell of several machines: one authority, one certificate for the cell, one for each sensor.

The authority's private key is used once and forgotten: to add a sensor, all certificates are made anew. ECDSA P-256.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
from collections.abc import Iterable
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

CELL = "cell"
VALID = datetime.timedelta(days=730)


def make(folder: Path, host: str, sensors: Iterable[str]) -> list[Path]:
    """Write authority.pem and, for the cell and each sensor, NAME.pem and NAME.key; what was written.

    `host`: name or address that the cell listens on. FileExistsError: there are keys already.
    """
    folder.mkdir(parents=True, exist_ok=True)
    issuer = _name("asc authority")
    authority_key = ec.generate_private_key(ec.SECP256R1())
    authority = _build(issuer, issuer, authority_key.public_key(), [(x509.BasicConstraints(True, 0), True)])
    written = [_write(folder / "authority.pem", _pem(authority.sign(authority_key, hashes.SHA256())), 0o644)]
    for name in (CELL, *sensors):
        key = ec.generate_private_key(ec.SECP256R1())
        places = [_place(host)] if name == CELL else [x509.DNSName(name)]
        usage = [ExtendedKeyUsageOID.SERVER_AUTH if name == CELL else ExtendedKeyUsageOID.CLIENT_AUTH]
        extensions: list[tuple[x509.ExtensionType, bool]] = [
            (x509.BasicConstraints(False, None), True),
            (x509.SubjectAlternativeName(places), False),
            (x509.ExtendedKeyUsage(usage), False),
        ]
        certificate = _build(_name(name), issuer, key.public_key(), extensions).sign(authority_key, hashes.SHA256())
        private = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        written.append(_write(folder / f"{name}.pem", _pem(certificate), 0o644))
        written.append(_write(folder / f"{name}.key", private, 0o600))
    return written


def _build(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    extensions: list[tuple[x509.ExtensionType, bool]],
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
    builder = builder.serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(now - datetime.timedelta(days=1)).not_valid_after(now + VALID)
    for extension, is_critical in extensions:
        builder = builder.add_extension(extension, is_critical)
    return builder


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _place(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _write(path: Path, data: bytes, mode: int) -> Path:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
    return path
