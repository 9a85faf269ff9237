"""The process: where it listens, whom it answers and when it ends."""

from __future__ import annotations

import argparse
import hmac
import io
import ipaddress
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent import futures
from pathlib import Path
from typing import Any, NoReturn

import grpc

from magex._environment import Environment
from magex._problems import Problem, Refused
from magex._service import Service
from magex._wire import environment_pb2_grpc

#: Path of the Unix socket on which an environment that an actor started listens.
SOCKET = "MAGEX_ENVIRONMENT_SOCKET"

MESSAGE_BYTES_MAX = 256 * 1024 * 1024
#: Every stream holds a thread; threads are made when they are needed.
STREAMS_MAX = 256


def serve(
    make: Callable[..., Any],
    *,
    worlds: int | None = None,
    address: str | None = None,
    deterministic: bool | None = None,
    successes: bool | None = None,
    pad: bool = False,
    state: bool = True,
    renders: bool | None = None,
    tls_certificate: str | os.PathLike[str] | None = None,
    tls_key: str | os.PathLike[str] | None = None,
    token: str | None = None,
    insecure: bool = False,
) -> None:
    """Serves the environments that `make` returns. Does not return before the process is to end.

    `make` is a function (or class) without arguments that returns a PettingZoo Parallel environment, a Gymnasium environment or a
    `magex.VectorEnvironment`; or a function of the number of worlds that returns a Gymnasium vector environment.

    * worlds: largest number of worlds that one caller may have; None is any.
    * address: HOST:PORT where an environment listens that no actor started; None is `--address` of the command line, or a free
      port of 127.0.0.1. An actor says by the environment variable MAGEX_ENVIRONMENT_SOCKET where to listen instead.
    * deterministic: whether an episode is a function of its seed and its actions; None plays 200 steps to find out.
    * successes: whether infos say at the end of an episode if it was a success (`is_success` or `success`); None looks in the
      same steps. With both given nothing is played.
    * pad: fills up observations and actions of agents that have smaller spaces than others.
    * state: False never asks for state(); the critic then sees all observations.
    * renders: False never renders; None renders if the environment's render_mode is "rgb_array".
    * tls_certificate, tls_key: PEM files, and token: what callers must present. Beyond loopback all three are needed, unless
      insecure=True.
    """
    try:
        environment = Environment(make, worlds=worlds, pad=pad, state=state, renders=renders)
        service = Service(environment, deterministic, successes)
        socket = os.environ.get(SOCKET)
        if socket:
            _serve_actor(service, socket)
        else:
            chosen = address or _address_of(sys.argv[1:]) or "127.0.0.1:0"
            _serve_address(service, chosen, tls_certificate, tls_key, token, insecure)
    except (Refused, Problem) as error:
        print(f"magex: {error}", file=sys.stderr, flush=True)
        raise SystemExit(1) from None


def start(
    service: Service, address: str, credentials: grpc.ServerCredentials | None = None, token: str | None = None
) -> tuple[grpc.Server, int]:
    """Listens; returns the server and its port."""
    server = grpc.server(
        futures.ThreadPoolExecutor(max_workers=STREAMS_MAX, thread_name_prefix="magex"),
        interceptors=[_Token(token)] if token else [],
        options=[
            ("grpc.max_receive_message_length", MESSAGE_BYTES_MAX),
            ("grpc.max_send_message_length", MESSAGE_BYTES_MAX),
            # During a long step a caller asks from time to time whether the connection lives. gRPC would take that for an attack.
            ("grpc.http2.max_ping_strikes", 0),
            # Two environments on one port would share their callers at random.
            ("grpc.so_reuseport", 0),
        ],
    )
    environment_pb2_grpc.add_EnvironmentServiceServicer_to_server(service, server)
    try:
        port = server.add_secure_port(address, credentials) if credentials else server.add_insecure_port(address)
    except RuntimeError:
        port = 0
    if port == 0:
        raise Refused(f"address: cannot listen on {address}; it may be in use, or not an address of this machine")
    server.start()
    return server, port


def _serve_actor(service: Service, socket: str) -> None:
    # The kernel's limit for the path of a socket, which gRPC does not name.
    if len(os.fsencode(socket)) > 107:
        raise Refused(f"{SOCKET}: {len(os.fsencode(socket))} bytes; a socket's path has at most 107")
    if threading.current_thread() is threading.main_thread():
        # Ctrl-C reaches the whole terminal. The actor finishes its work first, and needs its environment for that.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # The actor logs what the environment prints; in a pipe Python would hold it back.
        sys.stdout.reconfigure(line_buffering=True)
    threading.Thread(target=_end_with_input, daemon=True, name="magex-parent").start()
    # A server without a reference to it is collected, and its socket removed.
    server, _ = start(service, f"unix:{socket}")
    server.wait_for_termination()


def _end_with_input() -> None:
    """Ends the process when its standard input ends: the actor holds the other end for as long as it lives.

    Nothing is closed in order, for a step that hangs would hold that up.
    """
    try:
        while os.read(0, 4096):
            pass
    except OSError:
        pass
    _end()


def _end() -> NoReturn:
    """Ends the process without waiting for a step that may never end."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            pass
    os._exit(0)


def _serve_address(
    service: Service,
    address: str,
    tls_certificate: str | os.PathLike[str] | None,
    tls_key: str | os.PathLike[str] | None,
    token: str | None,
    insecure: bool,
) -> None:
    credentials = check_address(address, tls_certificate, tls_key, token, insecure)
    # A person waits at the terminal: what cannot be served is said before it listens.
    service.environment.layout()
    server, port = start(service, address, credentials, token)
    host = address.rpartition(":")[0]
    print(f"{'https' if credentials else 'http'}://{host}:{port}", flush=True)
    try:
        server.wait_for_termination()
    except KeyboardInterrupt:
        server.stop(grace=None).wait(1.0)
        _end()


def check_address(
    address: str,
    tls_certificate: str | os.PathLike[str] | None,
    tls_key: str | os.PathLike[str] | None,
    token: str | None,
    insecure: bool,
) -> grpc.ServerCredentials | None:
    """Refuses an address that strangers can reach, and reads the files."""
    host, colon, port = address.rpartition(":")
    if not colon or not host or not port.isdigit() or int(port) > 65535:
        raise Refused(f"address: {address} is not HOST:PORT; give 127.0.0.1:50061 for instance")
    if (tls_certificate is None) != (tls_key is None):
        missing = "tls_key" if tls_key is None else "tls_certificate"
        raise Refused(f"{missing}: missing; give tls_certificate and tls_key together")
    if token is not None and (not token or not token.isascii() or any(c.isspace() for c in token)):
        raise Refused("token: empty, or with characters that no header takes; give printable ASCII without blanks")
    secured = tls_certificate is not None and token is not None
    if not (_is_loopback(host) or secured or insecure):
        raise Refused(
            f"address: {address} can be reached from outside; give tls_certificate, tls_key and token, or insecure=True"
        )
    if tls_certificate is None or tls_key is None:
        return None
    parts = []
    for name, path in (("tls_key", tls_key), ("tls_certificate", tls_certificate)):
        try:
            parts.append(Path(path).read_bytes())
        except OSError as error:
            raise Refused(f"{name}: cannot read {path}: {error.strerror}") from None
        if b"-----BEGIN " not in parts[-1]:
            raise Refused(f"{name}: {path} is no PEM file")
    return grpc.ssl_server_credentials([(parts[0], parts[1])])


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _address_of(arguments: list[str]) -> str | None:
    """`--address` among the arguments of the user's own program, whose other arguments are none of our business."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--address")
    return parser.parse_known_args(arguments)[0].address


class _Token(grpc.ServerInterceptor):
    """Answers only calls with `authorization: Bearer TOKEN`."""

    def __init__(self, token: str) -> None:
        self.expected = f"Bearer {token}".encode()

        def refuse(_: Any, context: grpc.ServicerContext) -> None:
            context.abort(grpc.StatusCode.UNAUTHENTICATED, "authorization: missing or wrong; send 'authorization: Bearer TOKEN'")

        self.unary: Any = grpc.unary_unary_rpc_method_handler(refuse)
        self.stream: Any = grpc.stream_stream_rpc_method_handler(refuse)

    def intercept_service(self, continuation: Callable[..., Any], details: Any) -> Any:
        given = dict(details.invocation_metadata).get("authorization", "")
        if hmac.compare_digest(str(given).encode(), self.expected):
            return continuation(details)
        handler = continuation(details)
        return self.stream if handler is not None and handler.request_streaming else self.unary
