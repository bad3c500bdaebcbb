"""Certificates for a cluster's own use: an authority, and one certificate that it signed.

Dask's parts trust whom the authority signed, whatever the machine's name. The authority's key is
thrown away: no further certificate can be made that the cluster would trust.
"""

from __future__ import annotations

import datetime
import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sweep.tasks.errors import ClusterError

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

NAME = "sweep"

_USES = (
    "digital_signature", "content_commitment", "key_encipherment", "data_encipherment",
    "key_agreement", "key_cert_sign", "crl_sign", "encipher_only", "decipher_only",
)  # fmt: skip


class Files(NamedTuple):
    """Files of a cluster's certificates."""

    ca: Path
    certificate: Path
    key: Path


def make(directory: Path, days: int) -> Files:
    """Return new certificates in a directory, which only their owner may read.

    ClusterError where there are some already, or the directory can't be written.
    """
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    files = Files(*(directory / f"{name}.pem" for name in Files._fields))
    if there := [file for file in files if file.exists()]:
        raise ClusterError(f"{there[0]} is there already: name another directory")
    authority_key, key = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    authority = _signed(f"{NAME} authority", authority_key, authority_key, None, days)
    certificate = _signed(NAME, key, authority_key, authority, days)
    pem = serialization.Encoding.PEM
    secret = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    contents = (authority.public_bytes(pem), certificate.public_bytes(pem), secret)
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        for file, content in zip(files, contents, strict=True):
            with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
                out.write(content)
    except OSError as error:
        raise ClusterError(f"{directory} can't be written: {error}") from error
    return files


def _signed(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    authority_key: ec.EllipticCurvePrivateKey,
    authority: x509.Certificate | None,
    days: int,
) -> x509.Certificate:
    """Certificate of a name; of the authority itself where there is none yet."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.x509.oid import NameOID

    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    signs = authority is None
    usage = dict.fromkeys(_USES, False) | {
        "digital_signature": not signs, "key_cert_sign": signs, "crl_sign": signs,
    }  # fmt: skip
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(authority.subject if authority else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))  # clocks differ
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=signs, path_length=None), critical=True)
        .add_extension(x509.KeyUsage(**usage), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()),
            critical=False,
        )
    )
    return builder.sign(authority_key, hashes.SHA256())
