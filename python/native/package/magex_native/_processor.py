"""Whether this processor has the instructions that the wheel was compiled for (x86-64-v3)."""

from __future__ import annotations

import platform

#: What the level x86-64-v3 adds, by the names of /proc/cpuinfo (abm contains lzcnt).
NEEDED = ("avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe")


def flags(path: str = "/proc/cpuinfo") -> set[str] | None:
    """What the processor says that it has; None where that is not known."""
    try:
        with open(path, encoding="ascii", errors="replace") as file:
            for line in file:
                name, _, value = line.partition(":")
                if name.strip() == "flags":
                    return set(value.split())
    except OSError:
        pass
    return None


def check(path: str = "/proc/cpuinfo") -> None:
    """Raises ImportError if the processor is known to lack an instruction."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return
    found = flags(path)
    missing = [] if found is None else [name for name in NEEDED if name not in found]
    if missing:
        raise ImportError(
            f"magex_native is compiled for x86-64-v3 (most processors since 2015), and this one lacks {', '.join(missing)}; "
            "run it on another machine"
        )
