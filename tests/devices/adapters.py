"""Scripted I2C adapters of several tests of drivers have this in common."""

from __future__ import annotations


class Adapter:
    """The calls of an I2C adapter that its transactions do not depend on."""

    def set_timeout(self, units_10ms: int) -> None:
        pass

    def close(self) -> None:
        pass
