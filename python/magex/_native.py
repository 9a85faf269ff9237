"""The compiled part, asked for where it is needed: the rest of the package works without it."""

from __future__ import annotations

from types import ModuleType

REMEDY = (
    "{what} needs the compiled package magex-native, which is not installed; "
    "build and install it: python/native/build DIR && pip install DIR/magex_native-*.whl"
)


def native(what: str) -> ModuleType:
    """The module magex_native; ImportError with the remedy if there is none. `what` names the caller in the message."""
    try:
        import magex_native
    except ModuleNotFoundError as error:
        if error.name != "magex_native":
            raise
        raise ImportError(REMEDY.format(what=what)) from None
    return magex_native
