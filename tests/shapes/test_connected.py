"""Connected objects described in YAML: the arm with a claw, and everything that can be wrong."""

import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import ValidationError

from emt.linalg import Vec2
from emt.shapes.connected import ConnectedSettings, connected
from emt.shapes.linkage import place

ARM = {
    "parameters": {
        "length_a": "length", "alpha_a": "angle", "length_b": "length", "alpha_b": "angle", "alpha_c": "angle",
    },
    "components": {
        "hub": {"kind": "disc", "radius": "30 cm"},
        "finger_1": {"kind": "segment", "after": "lower", "length": 0.75, "angle": {"alpha_c": 0.5}},
        "upper": {"kind": "segment", "length": "length_a", "angle": {"alpha_a": 1.0}},
        "lower": {
            "kind": "segment", "after": "upper", "length": "length_b", "angle": {"alpha_b": 1.0}, "offset": "-180 deg",
        },
        "finger_2": {"kind": "segment", "after": "lower", "length": 0.75, "angle": {"alpha_c": -0.5}},
    },
}  # fmt: skip


def changed(component, **settings):
    part = {**ARM["components"].get(component, {"kind": "segment", "length": 1.0}), **settings}
    return {**ARM, "components": {**ARM["components"], component: part}}


def test_the_arm_stands_as_drawn():
    """With all angles at 90 degrees: first arm up, second to the right, fingers at 45 degrees to both sides."""
    arm = connected(ConnectedSettings.model_validate(ARM))
    assert arm.state == (
        "length_a", "alpha_a", "alpha_a_rate", "length_b", "alpha_b", "alpha_b_rate", "alpha_c", "alpha_c_rate",
    )  # fmt: skip
    assert arm.angles == (1, 4, 6)
    assert arm.components == ("hub", "finger_1", "upper", "lower", "finger_2")
    assert arm.discs == ((0, 0.3, (0.0, 0.0)),)
    right = np.pi / 2
    state = jnp.array([1.0, right, 0.0, 1.0, right, 0.0, right, 0.0])
    placed = place(arm.links, state, Vec2(jnp.asarray(0.0), jnp.asarray(0.0)))
    found = {arm.components[component]: placed[link] for component, link in arm.segments}
    slope = 0.75 * np.sqrt(0.5)
    for name, start, end in [
        ("upper", (0, 0), (0, 1)),
        ("lower", (0, 1), (1, 1)),
        ("finger_1", (1, 1), (1 + slope, 1 + slope)),
        ("finger_2", (1, 1), (1 + slope, 1 - slope)),
    ]:
        np.testing.assert_allclose(found[name].start.array(), start, atol=1e-12)
        np.testing.assert_allclose(found[name].at(jnp.asarray(1.0)).array(), end, atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            changed("upper", angle={"alpha_x": 1.0}),
            r"components\.upper\.angle: unknown parameter 'alpha_x' .did you mean",
        ),
        (changed("upper", length="alpha_a"), r"components\.upper\.length: 'alpha_a' is no length"),
        (changed("lower", angle={"length_a": 1.0}), r"components\.lower\.angle: 'length_a' is no angle"),
        (changed("lower", after="uper"), r"there is no segment 'uper' \(did you mean 'upper'"),
        (changed("lower", after="hub"), "there is no segment 'hub'"),
        (changed("upper", after="finger_1"), "finger_1 after lower after upper after finger_1 is a circle"),
        (changed("upper", after="upper"), "is a circle"),
        (changed("finger_1", length=-0.5), "finger_1"),
        (changed("hub", radius=0.0), "radius"),
        ({**ARM, "parameters": {**ARM["parameters"], "alpha_d": "angle"}}, "no component reads alpha_d"),
        ({**ARM, "parameters": {**ARM["parameters"], "alpha_c": "weight"}}, "alpha_c"),
        ({**ARM, "components": {}}, "components"),
    ],
)
def test_refusals(settings, message):
    with pytest.raises(ValidationError, match=message):
        ConnectedSettings.model_validate(settings)
