"""Diffeomorphisms ψ: flows of vector fields, their chains and inverses (sec. 4.1, 4.2).

ψ maps from the manifold *with* a behaviour to the one *without* it; ψ⁻¹ adds the behaviour.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from dt_viz.errors import check_between
from dt_viz.flows.fields import Array, VectorField
from dt_viz.flows.integrators import DORMAND_PRINCE, EULER, RK4, carried


@dataclass(frozen=True, eq=False)
class Diffeomorphism(ABC):
    """A smooth bijection of R^d with smooth inverse.

    A subclass defines `dim`, and `_map` for both directions; everything else follows. Points have shape (*B, d).
    """

    SCALED: ClassVar[tuple[str, ...]] = ()
    """Names of the fields that `scaled` scales: numbers, arrays and transforms. Without any, a transform stays."""

    @property
    @abstractmethod
    def dim(self) -> int:
        """Dimension d of the space."""

    @abstractmethod
    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        """Image of points `s` (N, d) under ψ or ψ⁻¹, and of tangents `U` (N, d, k) under its derivative."""

    def scaled(self, fraction: float) -> Diffeomorphism:
        """The transform between the identity (fraction 0) and ψ (1): each flow runs for a fraction of its duration.

        A flow becomes γ(fraction·t, ·), so scaled(a)∘scaled(b) = scaled(a + b), and a chain that of its scaled parts.
        The number of steps stays, so an exact inverse stays exact.
        """
        whole = {name: getattr(self, name) for name in self.SCALED}
        parts = {k: v.scaled(fraction) if isinstance(v, Diffeomorphism) else fraction * v for k, v in whole.items()}
        return replace(self, **parts) if parts else self

    def forward(self, y: Array) -> Array:
        """ψ(y), (*B, d)."""
        return self._batched(y, None, inverse=False)[0]

    def inverse(self, x: Array) -> Array:
        """ψ⁻¹(x), (*B, d)."""
        return self._batched(x, None, inverse=True)[0]

    def forward_tangents(self, y: Array, U: Array) -> tuple[Array, Array]:
        """ψ(y) (*B, d) and Dψ(y)·U (*B, d, k) for k tangents `U` (*B, d, k) at once."""
        x, V = self._batched(y, U, inverse=False)
        assert V is not None
        return x, V

    def inverse_tangents(self, x: Array, U: Array) -> tuple[Array, Array]:
        """ψ⁻¹(x) (*B, d) and Dψ⁻¹(x)·U (*B, d, k) for k tangents `U` (*B, d, k) at once."""
        y, V = self._batched(x, U, inverse=True)
        assert V is not None
        return y, V

    def jacobian(self, y: Array) -> tuple[Array, Array]:
        """ψ(y) (*B, d) and its Jacobian J(y) (*B, d, d)."""
        return self.forward_tangents(y, _identity_like(y))

    def inverse_jacobian(self, x: Array) -> tuple[Array, Array]:
        """ψ⁻¹(x) (*B, d) and the Jacobian of ψ⁻¹ there, (*B, d, d)."""
        return self.inverse_tangents(x, _identity_like(x))

    def __matmul__(self, inner: Diffeomorphism) -> Chain:
        """Composition: (f @ g)(y) = f(g(y))."""
        return Chain([self, inner])

    def _batched(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        if s.shape[-1] != self.dim:
            raise ValueError(f"points have {s.shape[-1]} coordinates; this diffeomorphism acts on R^{self.dim}")
        flat, V = self._map(
            s.reshape(-1, self.dim), None if U is None else U.reshape(-1, *U.shape[-2:]), inverse=inverse
        )
        return flat.reshape(s.shape), None if V is None or U is None else V.reshape(U.shape)


@dataclass(frozen=True)
class Flow(Diffeomorphism):
    """ψ(y) = γ(t, y), the solution at time t of ṡ = V(s), s(0) = y; ψ⁻¹(x) = γ(−t, x) (sec. 4.2)."""

    SCALED = ("duration",)
    field: VectorField
    duration: float = 1.0
    steps: int = 8
    method: int = RK4  # method of `dt_viz.flows.integrators`
    inverse_method: int | None = None
    """Method for ψ⁻¹; None takes `method`. `IMPLICIT_EULER` with `EULER` gives an inverse exact to rounding."""
    tolerance: float = 0.0
    """Largest estimated error of an adaptive step of the points, in their unit. Tangents obey `TANGENT_TOLERANCE`
    instead: where space is squeezed strongly, det J may be off by some per cent."""

    @classmethod
    def adaptive(cls, field: VectorField, duration: float, tolerance: float = 1e-8) -> Flow:
        """Make the flow with steps for each point by itself, so long that they keep the tolerance.

        For fields that are steep in a small core and flat elsewhere, such as those of obstacles.
        """
        return cls(field, duration, MOST_STEPS, DORMAND_PRINCE, tolerance=tolerance)

    @property
    def dim(self) -> int:
        return self.field.dim

    def min_step_determinant(self, s: Array, *, inverse: bool) -> float:
        """Smallest det of the derivative of a step of ψ from points `s` (N, d), or of ψ⁻¹.

        Where it is not positive, the step folds space: the numerical map is no diffeomorphism, though the flow is one.
        """
        step, smallest = replace(self, duration=self.duration / self.steps, steps=1), np.inf
        for _ in range(self.steps):
            s, J = step.inverse_jacobian(s) if inverse else step.jacobian(s)
            smallest = min(smallest, float(np.linalg.det(J).min(initial=np.inf)))
        return smallest

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        method = self.method if self.inverse_method is None or not inverse else self.inverse_method
        duration = -self.duration if inverse else self.duration
        return carried(self.field, s, U, method, duration, self.steps, self.tolerance)


@dataclass(frozen=True, init=False)
class Chain(Diffeomorphism):
    """Chain([f, g]) = f∘g: the last is applied first. Raises ValueError on an empty or mixed-dimension list."""

    parts: tuple[Diffeomorphism, ...]

    def __init__(self, parts: Sequence[Diffeomorphism]) -> None:
        flat = tuple(p for part in parts for p in (part.parts if isinstance(part, Chain) else (part,)))
        if len({p.dim for p in flat}) != 1:
            raise ValueError(f"a chain needs parts of one dimension, got {[p.dim for p in flat]}")
        object.__setattr__(self, "parts", flat)

    @property
    def dim(self) -> int:
        return self.parts[0].dim

    def scaled(self, fraction: float) -> Chain:
        return Chain([part.scaled(fraction) for part in self.parts])

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        for part in self.parts if inverse else reversed(self.parts):
            s, U = part._map(s, U, inverse=inverse)
        return s, U


@dataclass(frozen=True)
class Identity(Diffeomorphism):
    """The transform that changes nothing: a layer that is switched off."""

    dimension: int

    @property
    def dim(self) -> int:
        return self.dimension

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        return s, U


@dataclass(frozen=True)
class Conjugated(Diffeomorphism):
    """h⁻¹∘ψ∘h: ψ acts in the coordinates h(y). Scaling it scales ψ and leaves the coordinates as they are."""

    SCALED = ("inner",)
    inner: Diffeomorphism  # ψ
    by: Diffeomorphism  # h

    @property
    def dim(self) -> int:
        return self.by.dim

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        s, U = self.by._map(s, U, inverse=False)
        s, U = self.inner._map(s, U, inverse=inverse)
        return self.by._map(s, U, inverse=True)


@dataclass(frozen=True)
class Placed(Diffeomorphism):
    """A diffeomorphism of R^k placed in R^d (k ≤ d): it acts on the first k coordinates of a rigid, scaled frame.

    A point y has frame coordinates u = Rᵀ(y − o)/scale; ψ acts on u_1..u_k and leaves the others as they are. This is
    how a motion learned in a drawing plane becomes a motion of the robot's hand.
    """

    SCALED = ("inner",)
    inner: Diffeomorphism
    origin: Array  # o, (d,), metres
    axes: Array  # R, (d, d), orthonormal columns: the frame's axes in the world
    scale: float = 1.0  # world metres for one unit of `inner`

    @property
    def dim(self) -> int:
        return len(self.origin)

    def to_world(self, u: Array) -> Array:
        """World points (*B, d) of frame coordinates (*B, k or d); missing coordinates are zero."""
        return self.origin + self.scale * (u @ self.axes[:, : u.shape[-1]].T)

    def to_frame(self, y: Array) -> Array:
        """Frame coordinates (*B, d) of world points (*B, d)."""
        return (y - self.origin) @ self.axes / self.scale

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        k = self.inner.dim
        u = self.to_frame(s)
        W = None if U is None else self.axes.T @ U / self.scale
        head, tangent = self.inner._map(u[:, :k], None if W is None else W[:, :k], inverse=inverse)
        s = self.to_world(np.concatenate([head, u[:, k:]], axis=1))
        if W is None or tangent is None:
            return s, None
        return s, self.scale * (self.axes @ np.concatenate([tangent, W[:, k:]], axis=1))


Method = Literal["auto", "rk4", "euler"]
"""`auto` keeps the result exact to a tolerance; the others take equal steps, Euler's being the paper's."""
MAX_STEPS, MOST_STEPS = 50, 1000  # largest numbers of steps of a flow: on the page, and at all


@dataclass(frozen=True)
class Integration:
    """A method and, where it is not `auto`, its number of steps. Raises FormatError on another number of them."""

    method: Method = "auto"
    steps: int = 8

    def __post_init__(self) -> None:
        check_between("steps", self.steps, 1, MOST_STEPS)

    @property
    def by_hand(self) -> bool:
        """Whether the user chose the steps, so that no tolerance is guaranteed."""
        return self.method != "auto"

    def of(self, flow: Flow) -> Flow:
        """The flow integrated by this method; `auto` leaves `flow` as it is."""
        if self.method == "auto":
            return flow
        return Flow(flow.field, flow.duration, self.steps, RK4 if self.method == "rk4" else EULER)

    def __str__(self) -> str:
        """Name on the page, such as "Euler in 3 steps"."""
        steps = "1 step" if self.steps == 1 else f"{self.steps} steps"
        return {"auto": "auto", "rk4": f"RK4 in {steps}", "euler": f"Euler in {steps}"}[self.method]


AUTO = Integration()


def _identity_like(points: Array) -> Array:
    d = points.shape[-1]
    return np.broadcast_to(np.eye(d), (*points.shape[:-1], d, d))


def round_trip_error(transform: Diffeomorphism, y: Array) -> float:
    """Largest ‖ψ⁻¹(ψ(y)) − y‖ over the points `y` (*B, d), in their unit: a certificate, computed and never assumed."""
    return float(np.linalg.norm(transform.inverse(transform.forward(y)) - y, axis=-1).max(initial=0.0))


def min_det_jacobian(jacobian: Callable[[Array], tuple[Array, Array]], points: Array) -> float:
    """Smallest det J over `points` (*B, d): positive wherever the transform keeps its orientation, so is invertible."""
    return float(np.linalg.det(jacobian(points)[1]).min(initial=np.inf))
