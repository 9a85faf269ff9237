"""`python -m magex.serve module:callable` serves an environment that needs no file of its own."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from typing import Any

from magex._problems import Refused, describe
from magex._server import serve


def load(name: str) -> Any:
    """The callable that `module:callable` names."""
    module, colon, attribute = name.partition(":")
    if not colon or not module or not attribute:
        raise Refused(f"environment: {name} is not module:callable; give mpe2.simple_spread_v3:parallel_env for instance")
    # As `python my_env.py` would: modules beside the caller are found.
    sys.path.insert(0, os.getcwd())
    try:
        found: Any = importlib.import_module(module)
    except Exception as error:
        raise Refused(f"environment: cannot import {module}: {describe(error)}") from None
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise Refused(f"environment: {module} has no {attribute}; give the name of a function or class in it")
        found = getattr(found, part)
    return found


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m magex.serve", description=__doc__)
    parser.add_argument("environment", metavar="MODULE:CALLABLE", help="what makes an environment")
    parser.add_argument("--worlds", type=int, metavar="W", help="largest number of worlds of one caller [default: any]")
    parser.add_argument("--address", metavar="HOST:PORT", help="where to listen [default: a free port of 127.0.0.1]")
    parser.add_argument("--pad", action="store_true", help="fill up the smaller spaces of agents whose spaces differ")
    parser.add_argument("--no-state", action="store_true", help="never ask for state(): the critic sees all observations")
    parser.add_argument("--deterministic", choices=("yes", "no"), help="[default: find out]")
    parser.add_argument("--tls-certificate", metavar="FILE")
    parser.add_argument("--tls-key", metavar="FILE")
    parser.add_argument("--token-file", metavar="FILE", help="[default: the environment variable MAGEX_TOKEN]")
    parser.add_argument("--insecure", action="store_true", help="answer every client that can reach the address")
    options = parser.parse_args(arguments)
    try:
        make = load(options.environment)
        token = os.environ.get("MAGEX_TOKEN") or None
        if options.token_file:
            try:
                with open(options.token_file, encoding="utf-8") as file:
                    token = file.read().strip()
            except OSError as error:
                raise Refused(f"--token-file: cannot read {options.token_file}: {error.strerror}") from None
    except Refused as error:
        print(f"magex: {error}", file=sys.stderr, flush=True)
        raise SystemExit(1) from None
    serve(
        make,
        worlds=options.worlds,
        address=options.address,
        deterministic=None if options.deterministic is None else options.deterministic == "yes",
        pad=options.pad,
        state=not options.no_state,
        tls_certificate=options.tls_certificate,
        tls_key=options.tls_key,
        token=token,
        insecure=options.insecure,
    )


class _Callable(type(sys)):  # type: ignore[misc]
    """`import magex.serve` binds the name to this module instead of the function; both can be called."""

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        serve(*args, **kwargs)


if __name__ == "__main__":
    main()
else:
    sys.modules[__name__].__class__ = _Callable
