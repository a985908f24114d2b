"""Connected objects in a configuration: parameters, and components placed along a kinematic chain."""

from typing import Annotated, Literal, NamedTuple

from pydantic import Field, StringConstraints, model_validator

from emt.registry import suggest
from emt.settings import Angle, Length, PositiveLength, Settings
from emt.shapes.linkage import Link

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


class ConnectedSettings(Settings):
    """An object of components that share parameters (Zea, Faion and Hanebeck 2014)."""

    parameters: Annotated[dict[Name, Literal["length", "angle"]], Field(min_length=1)]
    """Names of lengths and angles, in the order of the state; every angle is followed by its rate."""
    origin: tuple[Length, Length] = (0.0, 0.0)
    components: Annotated[
        dict[Name, Annotated[DiscSettings | SegmentSettings, Field(discriminator="kind")]], Field(min_length=1)
    ]

    @model_validator(mode="after")
    def _connected(self):
        faults = [fault for name, part in self.components.items() for fault in self._faults_of(name, part)]
        if not faults:
            faults = self._cycles()
        if not faults:
            read = {parameter for part in self._segments().values() for parameter in (part.length, *part.angle)}
            unread = [name for name in self.parameters if name not in read]
            faults = [f"parameters: no component reads {', '.join(unread)}"] if unread else []
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def _segments(self) -> dict[str, SegmentSettings]:
        return {name: part for name, part in self.components.items() if isinstance(part, SegmentSettings)}

    def _faults_of(self, name: str, part: DiscSettings | SegmentSettings) -> list[str]:
        if isinstance(part, DiscSettings):
            return []
        faults = []
        wanted = [("angle", "angle", parameter) for parameter in part.angle]
        wanted += [("length", "length", part.length)] if isinstance(part.length, str) else []
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


class Connected(NamedTuple):
    """A connected object, fixed when a program is compiled."""

    state: tuple[str, ...]
    """Names of the state: every parameter, every angle followed by `NAME_rate`."""
    angles: tuple[int, ...]
    """Places of the angles in the state; their rates follow them."""
    components: tuple[str, ...]
    """Names, in the order of the configuration."""
    segments: tuple[tuple[int, int], ...]
    """(component, link) of every segment; the links stand in an order in which parents come first."""
    links: tuple[Link, ...]
    discs: tuple[tuple[int, float, tuple[float, float]], ...]
    """(component, radius, centre) of every disc."""
    origin: tuple[float, float]


def connected(settings: ConnectedSettings) -> Connected:
    """The object of checked settings."""
    state: list[str] = []
    for name, kind in settings.parameters.items():
        state += [name] if kind == "length" else [name, f"{name}_rate"]
    place = {name: k for k, name in enumerate(state)}
    components = tuple(settings.components)
    order: list[str] = []
    segments = {name: part for name, part in settings.components.items() if isinstance(part, SegmentSettings)}
    while len(order) < len(segments):
        order += [n for n, p in segments.items() if n not in order and (p.after is None or p.after in order)]
    links = []
    for part in (segments[name] for name in order):
        angle = tuple((place[parameter], factor) for parameter, factor in part.angle.items())
        length = place[part.length] if isinstance(part.length, str) else part.length
        links.append(Link(None if part.after is None else order.index(part.after), angle, part.offset, length))
    return Connected(
        tuple(state),
        tuple(place[name] for name, kind in settings.parameters.items() if kind == "angle"),
        components,
        tuple((components.index(name), k) for k, name in enumerate(order)),
        tuple(links),
        tuple(
            (k, part.radius, part.center)
            for k, part in enumerate(settings.components.values())
            if isinstance(part, DiscSettings)
        ),
        settings.origin,
    )
