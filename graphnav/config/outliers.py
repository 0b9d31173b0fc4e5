"""Outliers: the settings common to every kind of measurement."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from graphnav.config.section import Section

SWITCH = ("off", "on", "automatic")
KERNELS = ("huber", "cauchy", "geman-mcclure", "tukey", "welsch", "gnc")
_BY_NAME = {"none": "off", None: "off", False: "off", True: "automatic"}  # values that earlier versions wrote


def _check_switch(value: Any) -> Any:
    value = _BY_NAME.get(value, value) if isinstance(value, str | bool) else value
    if value not in SWITCH:
        raise ValueError(f'\'{value}\' must be "off", "on" or "automatic"')
    return value


def _check_kernel(value: Any) -> Any:
    value = _BY_NAME.get(value, value) if isinstance(value, str | bool) else value
    if value not in (*SWITCH, *KERNELS):
        raise ValueError(f"'{value}' must be one of {', '.join((*SWITCH, *KERNELS))}")
    return value


def _check_gate(value: Any) -> Any:
    if value is None or isinstance(value, str | bool):
        value = _BY_NAME.get(value, value)
    number = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < float("inf")
    if not number and value not in SWITCH:
        raise ValueError(f'\'{value}\' must be "off", "on", "automatic" or a number above 0')
    return float(value) if number else value


Switch = Annotated[Literal["off", "on", "automatic"], BeforeValidator(_check_switch)]
Kernel = Annotated[str, BeforeValidator(_check_kernel)]
Gate = Annotated[float | str, BeforeValidator(_check_gate)]


class Outliers(Section):
    """Treatment of outliers, the same in every solver."""

    default_kernel: ClassVar[str] = "none"  # "automatic"
    default_gate: ClassVar[float | None] = None

    robust: Kernel = Field(
        "automatic", description=f"robust kernel in every solver: off, on (cauchy), automatic, {', '.join(KERNELS)}"
    )
    robust_scale: float = Field(3.0, gt=0, description="whitened norm of a whole measurement at which the kernel bends")
    gate: Gate = Field(
        "automatic",
        description="whitened norm of an innovation above which no solver uses it: off, on (6), automatic, a number",
    )

    @property
    def kernel(self) -> str:
        """The robust kernel in effect, "none" if there is none."""
        return {"off": "none", "on": "cauchy", "automatic": self.default_kernel}.get(self.robust, self.robust)

    @property
    def limit(self) -> float | None:
        """The gate in effect, None if there is none."""
        if isinstance(self.gate, str):
            return {"off": None, "on": 6.0, "automatic": self.default_gate}[self.gate]
        return self.gate

    @property
    def outliers(self) -> dict[str, Any]:
        """The arguments of a constraint that describe its treatment of outliers."""
        return {"robust": self.kernel, "robust_scale": self.robust_scale, "gate": self.limit}
