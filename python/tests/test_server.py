"""The process: where it listens, whom it answers and when it ends."""

from __future__ import annotations

import datetime
import ipaddress
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest

from magex._problems import Refused
from magex._server import check_address
from magex._wire import environment_pb2 as pb
from magex._wire import environment_pb2_grpc

HERE = Path(__file__).parent


HANGS = """
import time
from environments import Line

class Hangs(Line):
    def step(self, actions):
        print("hangs", flush=True)
        while True:
            time.sleep(1)
"""


@pytest.fixture
def launch() -> Iterator[Callable[..., subprocess.Popen]]:
    """launch(arguments of Python, ...) starts a process that ends with the test."""
    processes: list[subprocess.Popen] = []
    # A shell that runs the tests in the background makes them ignore Ctrl-C, and what they start.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def start(*arguments: str, socket: Path | None = None, **variables: str) -> subprocess.Popen:
        env = {**os.environ, "PYTHONPATH": f"{HERE}:{os.environ.get('PYTHONPATH', '')}"}
        env.pop("MAGEX_ENVIRONMENT_SOCKET", None)
        env.pop("MAGEX_TOKEN", None)
        if socket:
            env["MAGEX_ENVIRONMENT_SOCKET"] = str(socket)
        env.update(variables)
        pipe = subprocess.PIPE
        command = [sys.executable, *arguments]
        process = subprocess.Popen(command, env=env, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        processes.append(process)
        return processes[-1]

    yield start
    signal.signal(signal.SIGINT, before)
    for process in processes:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            pipe.close()


def describe(target: str, credentials: grpc.ChannelCredentials | None = None, token: str | None = None) -> Any:
    make = grpc.secure_channel if credentials else grpc.insecure_channel
    with make(target, *([credentials] if credentials else [])) as channel:
        stub = environment_pb2_grpc.EnvironmentServiceStub(channel)
        metadata = [("authorization", f"Bearer {token}")] if token else None
        return stub.Describe(pb.DescribeRequest(protocol=1), wait_for_ready=True, timeout=20, metadata=metadata)


def test_listens_where_the_actor_says_and_ends_with_its_input(launch, tmp_path: Path) -> None:
    process = launch("-m", "magex.serve", "environments:Line", socket=tmp_path / "s")
    assert describe(f"unix:{tmp_path}/s").name == "line"
    # Ctrl-C in the terminal is for the actor.
    process.send_signal(signal.SIGINT)
    assert describe(f"unix:{tmp_path}/s").name == "line"
    process.stdin.close()
    assert process.wait(timeout=5) == 0
    assert process.stdout.read() == "" and process.stderr.read() == ""


def test_ends_with_its_input_in_a_step_that_hangs(launch, tmp_path: Path) -> None:
    (tmp_path / "hangs.py").write_text(HANGS)
    process = launch(
        "-m",
        "magex.serve",
        "hangs:Hangs",
        socket=tmp_path / "s",
        PYTHONPATH=f"{HERE}:{tmp_path}:{os.environ.get('PYTHONPATH', '')}",
    )
    with grpc.insecure_channel(f"unix:{tmp_path}/s") as channel:
        call = environment_pb2_grpc.EnvironmentServiceStub(channel).Describe.future(
            pb.DescribeRequest(protocol=1), wait_for_ready=True
        )
        assert process.stdout.readline() == "hangs\n"
        process.stdin.close()
        assert process.wait(timeout=5) == 0
        call.cancel()


def test_prints_one_line_with_its_address(launch) -> None:
    process = launch("-m", "magex.serve", "environments:Line", "--address", "127.0.0.1:0")
    line = process.stdout.readline()
    assert line.startswith("http://127.0.0.1:") and not line.startswith("http://127.0.0.1:0\n")
    assert describe(line.strip().removeprefix("http://")).name == "line"
    # Its input means nothing here.
    process.stdin.close()
    time.sleep(0.3)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=5) == 0
    assert process.stderr.read() == ""


def test_ctrl_c_in_a_step_that_hangs(launch, tmp_path: Path) -> None:
    (tmp_path / "hangs.py").write_text(HANGS)
    path = f"{HERE}:{tmp_path}:{os.environ.get('PYTHONPATH', '')}"
    process = launch("-m", "magex.serve", "hangs:Hangs", "--address", "127.0.0.1:0", PYTHONPATH=path)
    target = process.stdout.readline().strip().removeprefix("http://")
    with grpc.insecure_channel(target) as channel:
        call = environment_pb2_grpc.EnvironmentServiceStub(channel).Describe.future(pb.DescribeRequest(protocol=1))
        assert process.stdout.readline() == "hangs\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=5) == 0
        call.cancel()


def test_a_file_of_the_users_own(launch, tmp_path: Path) -> None:
    file = tmp_path / "my_env.py"
    file.write_text("import magex\nfrom environments import Line\nmagex.serve(Line)\n")
    process = launch(str(file), "--mine", "--address", "127.0.0.1:0")
    assert describe(process.stdout.readline().strip().removeprefix("http://")).name == "line"


def test_two_on_one_port(launch) -> None:
    first = launch("-m", "magex.serve", "environments:Line", "--address", "127.0.0.1:0")
    address = first.stdout.readline().strip().removeprefix("http://")
    second = launch("-m", "magex.serve", "environments:Line", "--address", address)
    assert second.wait(timeout=20) == 1
    assert f"magex: address: cannot listen on {address}; it may be in use" in second.stderr.read()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["environments:Absent"], "magex: environment: environments has no Absent; give the name of a function or class in it"),
        (["environments"], "magex: environment: environments is not module:callable"),
        (["absent_module:x"], "magex: environment: cannot import absent_module: ModuleNotFoundError"),
        (
            ["environments:Line", "--address", "0.0.0.0:0"],
            "magex: address: 0.0.0.0:0 can be reached from outside; give tls_certificate, tls_key and token, or insecure=True",
        ),
        (["builtins:object"], "magex: make: returned <object object at"),
        (["environments:spaces"], "magex: make: "),
        (["environments:Line", "--token-file", "/absent"], "magex: --token-file: cannot read /absent"),
    ],
)
def test_refuses_in_one_line(launch, arguments: list[str], said: str) -> None:
    process = launch("-m", "magex.serve", *arguments)
    assert process.wait(timeout=20) == 1
    error = process.stderr.read()
    # On a busy machine gRPC itself may add a line when it ends.
    assert error.startswith(said) and "Traceback" not in error


def test_a_path_that_is_too_long(launch, tmp_path: Path) -> None:
    process = launch("-m", "magex.serve", "environments:Line", socket=tmp_path / ("s" * 108))
    assert process.wait(timeout=20) == 1
    assert "a socket's path has at most 107" in process.stderr.read()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate of its own for 127.0.0.1, and its key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "environment")])
    now = datetime.datetime.now(datetime.timezone.utc)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), False)
        .sign(key, hashes.SHA256())
    )
    folder = tmp_path_factory.mktemp("tls")
    (folder / "certificate.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    (folder / "key.pem").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return folder / "certificate.pem", folder / "key.pem"


def test_a_token_and_a_certificate(launch, files: tuple[Path, Path]) -> None:
    certificate, key = files
    process = launch(
        "-m",
        "magex.serve",
        "environments:Line",
        "--address",
        "0.0.0.0:0",
        "--tls-certificate",
        str(certificate),
        "--tls-key",
        str(key),
        MAGEX_TOKEN="s3cret",
    )
    line = process.stdout.readline()
    assert line.startswith("https://0.0.0.0:")
    target = "127.0.0.1:" + line.strip().rsplit(":", 1)[1]
    credentials = grpc.ssl_channel_credentials(certificate.read_bytes())
    assert describe(target, credentials, "s3cret").name == "line"
    for token in (None, "s3cre", "s3cret2"):
        with pytest.raises(grpc.RpcError) as error:
            describe(target, credentials, token)
        assert error.value.code() == grpc.StatusCode.UNAUTHENTICATED
        assert error.value.details() == "authorization: missing or wrong; send 'authorization: Bearer TOKEN'"
    with grpc.secure_channel(target, credentials) as channel:
        stream = environment_pb2_grpc.EnvironmentServiceStub(channel).Run(iter([pb.EnvironmentRequest()]))
        with pytest.raises(grpc.RpcError) as error:
            next(stream)
        assert error.value.code() == grpc.StatusCode.UNAUTHENTICATED
    with pytest.raises(grpc.RpcError) as error, grpc.insecure_channel(target) as channel:
        environment_pb2_grpc.EnvironmentServiceStub(channel).Describe(pb.DescribeRequest(protocol=1), timeout=5)
    assert error.value.code() == grpc.StatusCode.UNAVAILABLE


@pytest.mark.parametrize("address", ["127.0.0.1:5", "localhost:5", "[::1]:5", "127.9.9.9:0"])
def test_this_machine_needs_nothing(address: str) -> None:
    assert check_address(address, None, None, None, False) is None


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("0.0.0.0:5", None, None, None, False), "address: 0.0.0.0:5 can be reached from outside; give"),
        (("[::]:5", None, None, "t", False), "address: [::]:5 can be reached from outside; give"),
        (("example.org:5", "C", "K", None, False), "address: example.org:5 can be reached from outside; give"),
        (("127.0.0.1:5", "C", None, None, False), "tls_key: missing; give tls_certificate and tls_key together"),
        (("127.0.0.1:5", None, "K", None, True), "tls_certificate: missing"),
        (("127.0.0.1:5", "/absent", "/absent", None, False), "tls_key: cannot read /absent"),
        (("127.0.0.1:5", __file__, __file__, None, False), "is no PEM file"),
        (("127.0.0.1:5", None, None, "two words", False), "token: empty, or with characters"),
        (("127.0.0.1:5", None, None, "", False), "token: empty"),
        (("127.0.0.1", None, None, None, False), "address: 127.0.0.1 is not HOST:PORT"),
        (("127.0.0.1:http", None, None, None, True), "is not HOST:PORT"),
        (("127.0.0.1:70000", None, None, None, True), "is not HOST:PORT"),
    ],
)
def test_addresses_that_are_refused(arguments: tuple, said: str) -> None:
    with pytest.raises(Refused) as error:
        check_address(*arguments)
    assert said in str(error.value)


def test_insecure_is_said_aloud() -> None:
    assert check_address("0.0.0.0:5", None, None, None, True) is None


def test_the_module_can_be_called_too(launch) -> None:
    code = "import magex.serve, magex; assert callable(magex.serve); from magex.serve import serve; print(serve.__name__)"
    process = launch("-c", code)
    assert process.communicate() == ("serve\n", "")


def test_workers_that_an_environment_forks(launch, tmp_path: Path) -> None:
    (tmp_path / "workers.py").write_text(
        "import gymnasium\nfrom environments import Alone\n"
        "def make(n):\n"
        "    mode = gymnasium.vector.AutoresetMode.DISABLED\n"
        "    return gymnasium.vector.AsyncVectorEnv([Alone] * n, autoreset_mode=mode)\n"
    )
    path = f"{HERE}:{tmp_path}:{os.environ.get('PYTHONPATH', '')}"
    launch("-m", "magex.serve", "workers:make", socket=tmp_path / "s", PYTHONPATH=path)
    assert describe(f"unix:{tmp_path}/s").deterministic
