"""Connected objects in a configuration: parameters, and components placed along a kinematic chain."""

from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, StringConstraints, model_validator

from emt.registry import suggest
from emt.settings import Angle, Length, PositiveLength, Settings
from emt.shapes.linkage import Link

ROUNDING = 1e-9
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")]


class DiscSettings(Settings):
    """A filled disc that does not move."""

    kind: Literal["disc"] = "disc"
    radius: PositiveLength
    center: tuple[Length, Length] = (0.0, 0.0)


class SegmentSettings(Settings):
    """A straight segment with points uniform along it."""

    kind: Literal["segment"] = "segment"
    after: Name | None = None
    """Segment at whose end this one starts, and against whose direction its angle counts; by default the origin and
    the x axis."""
    length: PositiveLength | Name
    """A length, or the parameter that holds it."""
    angle: dict[Name, float] = Field(default_factory=dict)
    """Parameters that add to the angle, with their factors."""
    offset: Angle = 0.0
    """Added to the angle."""

    @property
    def lengths(self) -> tuple[float | str, ...]:
        return (self.length,)


class BodySettings(Settings):
    """An ellipse or a rectangle about its centre."""

    kind: Literal["ellipse", "rectangle"]
    points: Literal["surface", "outline"] = "surface"
    """Where points come from."""
    after: Name | None = None
    """Segment at whose end the centre lies, and against whose direction the angle counts; by default the origin and
    the x axis."""
    semi_axes: tuple[PositiveLength | Name, PositiveLength | Name]
    """Two lengths, or the parameters that hold them; the first lies along the angle."""
    angle: dict[Name, float] = Field(default_factory=dict)
    """Parameters that add to the angle, with their factors."""
    offset: Angle = 0.0
    """Added to the angle."""

    @property
    def lengths(self) -> tuple[float | str, ...]:
        return self.semi_axes


Moving = SegmentSettings | BodySettings


class ConnectedSettings(Settings):
    """An object of components that share parameters (Zea, Faion and Hanebeck 2014)."""

    parameters: Annotated[dict[Name, Literal["length", "angle"]], Field(min_length=1)]
    """Names of lengths and angles, in the order of the state; every angle is followed by its rate."""
    origin: tuple[Length, Length] = (0.0, 0.0)
    components: Annotated[
        dict[Name, Annotated[DiscSettings | Moving, Field(discriminator="kind")]],
        Field(min_length=1),
    ]

    @model_validator(mode="after")
    def _connected(self):
        faults = [fault for name, part in self.components.items() for fault in self._faults_of(name, part)]
        if not faults:
            faults = self._cycles()
        if not faults:
            moving = [part for part in self.components.values() if not isinstance(part, DiscSettings)]
            read = {parameter for part in moving for parameter in (*part.lengths, *part.angle)}
            unread = [name for name in self.parameters if name not in read]
            faults = [f"parameters: no component reads {', '.join(unread)}"] if unread else []
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def _segments(self) -> dict[str, SegmentSettings]:
        return {name: part for name, part in self.components.items() if isinstance(part, SegmentSettings)}

    def _faults_of(self, name: str, part: DiscSettings | Moving) -> list[str]:
        if isinstance(part, DiscSettings):
            return []
        faults = []
        wanted = [("angle", "angle", parameter) for parameter in part.angle]
        key = "length" if isinstance(part, SegmentSettings) else "semi_axes"
        wanted += [(key, "length", length) for length in part.lengths if isinstance(length, str)]
        for key, kind, parameter in wanted:
            if parameter not in self.parameters:
                near = suggest(parameter, self.parameters)
                hint = f" (did you mean '{near}'?)" if near else ""
                faults.append(f"components.{name}.{key}: unknown parameter '{parameter}'{hint}")
            elif self.parameters[parameter] != kind:
                faults.append(f"components.{name}.{key}: '{parameter}' is no {kind}")
        if part.after is not None and part.after not in self._segments():
            near = suggest(part.after, self._segments())
            hint = f" (did you mean '{near}'?)" if near else ""
            faults.append(f"components.{name}.after: there is no segment '{part.after}'{hint}")
        return faults

    def _cycles(self) -> list[str]:
        segments = self._segments()
        for name in segments:
            seen, here = [name], segments[name].after
            while here is not None:
                if here in seen:
                    return [f"components: {' after '.join([*seen, here])} is a circle"]
                seen.append(here)
                here = segments[here].after
        return []


def probability_faults(probabilities: dict[str, float] | None, names: tuple[str, ...]) -> list[str]:
    """What is wrong with the probabilities of components of these names."""
    if probabilities is None:
        return []
    unknown = [name for name in probabilities if name not in names]
    if unknown:
        near = suggest(unknown[0], names)
        hint = f" (did you mean '{near}'?)" if near else ""
        return [f"unknown component '{unknown[0]}'{hint}; known: {', '.join(names)}"]
    missing = [name for name in names if name not in probabilities]
    if missing:
        return [f"no probability for {', '.join(missing)}"]
    total = sum(probabilities.values())
    return [] if abs(total - 1.0) <= ROUNDING else [f"sum to {total:.6g}, not 1"]


def parameter_faults(shape: ConnectedSettings, lengths: dict[str, Any], angles: dict[str, Any]) -> list[str]:
    """What is wrong with values that should be given for every parameter of an object."""
    faults = []
    for key, kind, given in (("lengths", "length", lengths), ("angles", "angle", angles)):
        names = [name for name, of in shape.parameters.items() if of == kind]
        for name in given:
            if name not in names:
                near = suggest(name, names)
                hint = f" (did you mean '{near}'?)" if near else ""
                faults.append(f"{key}: the shape has no {kind} '{name}'{hint}; known: {', '.join(names) or 'none'}")
        if missing := [name for name in names if name not in given]:
            faults.append(f"{key}: no value for {', '.join(missing)}")
    return faults


class Body(NamedTuple):
    """An ellipse or a rectangle; fixed when a program is compiled."""

    component: int
    link: int
    """The link of length zero that holds its centre and direction."""
    semi_axes: tuple[int | float, int | float]
    """Parameters (ints) or lengths (floats)."""
    is_rectangle: bool
    is_filled: bool


class Connected(NamedTuple):
    """A connected object, fixed when a program is compiled."""

    state: tuple[str, ...]
    """Names of the state: every parameter, every angle followed by `NAME_rate`."""
    angles: tuple[int, ...]
    """Places of the angles in the state; their rates follow them."""
    components: tuple[str, ...]
    """Names, in the order of the configuration."""
    segments: tuple[tuple[int, int], ...]
    """(component, link) of every segment."""
    links: tuple[Link, ...]
    """Parents come first."""
    discs: tuple[tuple[int, float, tuple[float, float]], ...]
    """(component, radius, centre) of every disc."""
    bodies: tuple[Body, ...]
    origin: tuple[float, float]


def connected(settings: ConnectedSettings) -> Connected:
    """The object of checked settings."""
    state: list[str] = []
    for name, kind in settings.parameters.items():
        state += [name] if kind == "length" else [name, f"{name}_rate"]
    place = {name: k for k, name in enumerate(state)}
    components = tuple(settings.components)
    order: list[str] = []
    moving = {name: part for name, part in settings.components.items() if not isinstance(part, DiscSettings)}
    while len(order) < len(moving):
        order += [n for n, p in moving.items() if n not in order and (p.after is None or p.after in order)]
    links, segments, bodies = [], [], []
    for k, (name, part) in enumerate((name, moving[name]) for name in order):
        angle = tuple((place[parameter], factor) for parameter, factor in part.angle.items())
        lengths = [place[length] if isinstance(length, str) else length for length in part.lengths]
        if isinstance(part, SegmentSettings):
            length = lengths[0]
            segments.append((components.index(name), k))
        else:
            length, axes = 0.0, (lengths[0], lengths[1])
            is_rectangle, is_filled = part.kind == "rectangle", part.points == "surface"
            bodies.append(Body(components.index(name), k, axes, is_rectangle, is_filled))
        links.append(Link(None if part.after is None else order.index(part.after), angle, part.offset, length))
    return Connected(
        tuple(state),
        tuple(place[name] for name, kind in settings.parameters.items() if kind == "angle"),
        components,
        tuple(segments),
        tuple(links),
        tuple(
            (k, part.radius, part.center)
            for k, part in enumerate(settings.components.values())
            if isinstance(part, DiscSettings)
        ),
        tuple(bodies),
        settings.origin,
    )
