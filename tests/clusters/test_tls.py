"""Certificates: all parts talk TLS with them on, and whoever has none is refused."""

import gc
import ssl
import stat
from contextlib import suppress

import pytest
from click.testing import CliRunner
from cryptography import x509
from small_studies import file_digests, run_serially, small_spec

from sweep.cli import main
from sweep.spec import cluster_config_from_mapping
from sweep.tasks.engine import cluster_connection
from sweep.tasks.engine.deploy import local_ssh
from sweep.tasks.engine.progress import ClusterError


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return local_ssh.make_certificates(tmp_path_factory.mktemp("tls") / "new")


@pytest.fixture(scope="module")
def security(files):
    return {name: str(path) for name, path in files._asdict().items()}


def local(**sections):
    return cluster_config_from_mapping({"kind": "local", "workers": 1, **sections})


def test_certificates_are_their_owners_alone_and_good_for_a_year(files):
    certificate = x509.load_pem_x509_certificate(files.certificate.read_bytes())
    certificate.verify_directly_issued_by(x509.load_pem_x509_certificate(files.ca.read_bytes()))
    assert (certificate.not_valid_after_utc - certificate.not_valid_before_utc).days == 365
    assert all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in files)
    assert stat.S_IMODE(files.key.parent.stat().st_mode) == 0o700
    shake_hands(files)


def shake_hands(files) -> None:
    """A handshake in memory, either side checking the other's certificate in the strictest way."""
    client_side, server_side = ssl.MemoryBIO(), ssl.MemoryBIO()
    sides = []
    for server, incoming, outgoing in (
        (False, client_side, server_side),
        (True, server_side, client_side),
    ):
        purpose = ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT
        context = ssl.SSLContext(purpose)
        context.check_hostname = False
        context.verify_mode = ssl.CERT_REQUIRED
        context.verify_flags |= ssl.VERIFY_X509_STRICT
        context.load_verify_locations(files.ca)
        context.load_cert_chain(files.certificate, files.key)
        sides.append(context.wrap_bio(incoming, outgoing, server_side=server))
    is_done = [False, False]
    for _ in range(10):
        for i, side in enumerate(sides):
            with suppress(ssl.SSLWantReadError):
                side.do_handshake()
                is_done[i] = True
    assert all(is_done)


def test_the_command_prints_a_section_and_never_overwrites(tmp_path):
    result = CliRunner().invoke(main, ["certificates", str(tmp_path / "tls")])
    assert result.exit_code == 0
    import yaml

    assert local(**yaml.safe_load(result.output)).certificate_paths() is not None
    second_result = CliRunner().invoke(main, ["certificates", str(tmp_path / "tls")])
    assert second_result.exit_code == 2
    assert "is there already" in second_result.output


@pytest.mark.slow
def test_all_parts_talk_tls_and_a_client_without_certificates_is_refused(
    security, serial_store, tmp_path, monkeypatch
):
    from distributed import Security

    described = local(security=security, scheduler={"dashboard": "127.0.0.1:0"})
    monkeypatch.setattr(cluster_connection, "CONNECT_TIMEOUT_SECONDS", 2.0)
    with cluster_connection.connect_cluster(
        described, max_workers=9, processes=True, say=lambda _: None
    ) as reached:
        client, address = reached.client, reached.client.scheduler.address
        workers = client.scheduler_info()["workers"]
        assert address.startswith("tls://127.0.0.1:")
        assert workers and all(worker.startswith("tls://127.0.0.1:") for worker in workers)
        assert all(w["nanny"].startswith("tls://127.0.0.1:") for w in workers.values())

        outcome = run_serially(
            small_spec(), tmp_path / "tls.zarr", cluster=address_of(address, security)
        )
        assert outcome.complete
        assert file_digests(outcome.store) == file_digests(serial_store)

        plain_address = address.replace("tls://", "tcp://")
        with pytest.raises(ClusterError, match="no Dask scheduler answers"):
            run_serially(small_spec(), tmp_path / "plain.zarr", scheduler=plain_address)
        other_certificates = local_ssh.make_certificates(tmp_path / "others")
        stranger = address_of(address, {k: str(v) for k, v in other_certificates._asdict().items()})
        with pytest.raises(ClusterError, match="no Dask scheduler answers"):
            run_serially(small_spec(), tmp_path / "stranger.zarr", cluster=stranger)
        refuses(address, Security(require_encryption=True))
    assert not (tmp_path / "plain.zarr").exists()


def refuses(address: str, security) -> None:
    """See a client refused, and collected: amid the making of another it would wait for ever."""
    from distributed import Client

    with pytest.raises((OSError, TypeError)):
        Client(address, timeout=2, security=security, set_as_default=False)
    gc.collect()


@pytest.mark.slow
def test_a_client_that_could_not_connect_is_gone_before_another_is_made(monkeypatch):
    from distributed import Client

    monkeypatch.setattr(cluster_connection, "CONNECT_TIMEOUT_SECONDS", 0.2)
    gone, deleted = [], Client.__del__
    monkeypatch.setattr(Client, "__del__", lambda self: (gone.append(self.id), deleted(self)))
    with pytest.raises(ClusterError, match="no Dask scheduler answers") as refused:
        cluster_connection._connect_client(
            "tcp://127.0.0.1:1", cluster_config_from_mapping({"kind": "local"})
        )
    assert len(gone) == 1
    assert refused.value.__cause__ is not None  # nor is it kept by what is told


def address_of(address: str, security: dict[str, str]) -> dict:
    return {"kind": "scheduler", "address": address, "security": security}


@pytest.mark.parametrize("processes", [True, False])
def test_without_certificates_of_ones_own_nobody_else_gets_in(processes):
    import psutil
    from distributed import Security

    process = psutil.Process()
    before = listening([process, *process.children(recursive=True)])
    described = local(scheduler={"dashboard": "127.0.0.1:0"})
    with cluster_connection.connect_cluster(
        described, max_workers=9, processes=processes, say=lambda _: None
    ) as reached:
        reached.client.wait_for_workers(1)
        new_ports = listening([process, *process.children(recursive=True)]) - before
        address = reached.client.scheduler.address
        if processes:
            assert address.startswith("tls://127.0.0.1:")
            for security in (None, Security.temporary()):
                refuses(address, security)
            refuses(address.replace("tls", "tcp"), None)
    assert (
        len(new_ports) >= 3 if processes else len(new_ports) == 2
    )  # pages, of scheduler and worker
    assert {host for host, _ in new_ports} == {"127.0.0.1"}


def listening(processes) -> set[tuple[str, int]]:
    """Addresses that processes listen at."""
    return {
        (connection.laddr.ip, connection.laddr.port)
        for process in processes
        for connection in process.net_connections(kind="inet")
        if connection.status == "LISTEN"
    }


def test_certificates_reach_every_role(security):
    settings = local_ssh.security_settings(local(security=security))
    for role in ("client", "scheduler", "worker"):
        assert settings[f"tls_{role}_cert"] == security["certificate"]
        assert settings[f"tls_{role}_key"] == security["key"]
    assert settings["require_encryption"] is True
