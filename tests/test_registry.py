"""Names, suggestions, and plug-ins that are imported only when named."""

import sys
from importlib import metadata
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from emt.registry import PluginError, Registry, UnknownName, suggest


class Mine(BaseModel):
    kind: Literal["mine"] = "mine"


def build(settings: Mine) -> str:
    return f"built {settings.kind}"


@pytest.fixture
def registry() -> Registry[Any]:
    registry: Registry[Any] = Registry("filter", "emt_test.filters")
    registry.register("vb_random_matrix", Mine, build)
    registry.register("feldmann", Mine, build)
    return registry


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """Writes a module that can be imported during this test."""
    monkeypatch.syspath_prepend(tmp_path)
    written = []

    def write(name: str, text: str) -> None:
        (tmp_path / f"{name}.py").write_text(text)
        written.append(name)

    yield write
    for name in written:
        sys.modules.pop(name, None)


PLUGIN = """
from pydantic import BaseModel
class Mine(BaseModel):
    kind: str = "x"
    def build(self):
        return "built " + self.kind
class Outer:
    pair = (Mine, lambda settings: "pair")
number = 3
wrong = (int, print)
uncallable = (Mine, 3)
"""


def test_a_kind_has_settings_and_a_builder(registry):
    entry = registry.get("feldmann")
    assert (entry.name, entry.settings, entry.builder(entry.settings())) == ("feldmann", Mine, "built mine")
    assert registry.names() == registry.builtin() == ("feldmann", "vb_random_matrix")


def test_a_name_is_registered_once(registry):
    with pytest.raises(ValueError, match="filter 'feldmann' is registered twice"):
        registry.register("feldmann", Mine, build)
    with pytest.raises(TypeError, match="not a settings class"):
        registry.register("other", int, build)
    with pytest.raises(TypeError, match="cannot be called"):
        registry.register("other", Mine, 3)


def test_an_unknown_name_is_answered_with_the_nearest(registry):
    with pytest.raises(UnknownName) as caught:
        registry.get("feldman")
    assert str(caught.value) == (
        "unknown filter 'feldman' (did you mean 'feldmann'?); known: feldmann, vb_random_matrix"
    )
    assert caught.value.valid == ("feldmann", "vb_random_matrix")
    with pytest.raises(UnknownName) as caught:
        registry.get("zzz")
    assert caught.value.suggestion is None
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("seeds", "seed"), ("Seed", "seed"), ("sed", "seed"), ("vbb", "vb_random_matrix"), ("xyz", None), ("", None),
        ("vb-random-matrix", "vb_random_matrix"), ("random_matrix", "vb_random_matrix"), ("r", None), ("rnus", "runs"),
    ],
)  # fmt: skip
def test_suggestions(name, expected):
    assert suggest(name, ["seed", "runs", "vb_random_matrix"]) == expected


@given(st.text(max_size=20), st.lists(st.text(max_size=20), max_size=5))
def test_a_suggestion_is_a_candidate(name, candidates):
    assert suggest(name, candidates) in [None, *candidates]
    if name:
        assert suggest(name, [name]) == name


def test_module_attribute_is_imported_only_when_named(registry, plugin):
    plugin("emt_plugin_a", PLUGIN)
    registry.names()
    assert "emt_plugin_a" not in sys.modules
    entry = registry.get("emt_plugin_a:Mine")
    assert entry.name == "emt_plugin_a:Mine"
    assert entry.builder(entry.settings()) == "built x"
    assert registry.get("emt_plugin_a:Mine") is entry
    assert registry.get("emt_plugin_a:Outer.pair").builder(None) == "pair"
    assert registry.names() == ("feldmann", "vb_random_matrix")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("emt_plugin_b:none", "cannot be imported: AttributeError"),
        ("emt_no_such_module:x", "cannot be imported: ModuleNotFoundError"),
        ("emt_plugin_b:number", "is neither a settings class with 'build' nor a pair"),
        ("emt_plugin_b:wrong", "<class 'int'> is not a settings class"),
        ("emt_plugin_b:uncallable", "the builder 3 cannot be called"),
        ("emt_plugin_broken:x", "cannot be imported: ZeroDivisionError: division by zero"),
        ("emt_plugin_syntax:x", "cannot be imported: SyntaxError"),
    ],
)
def test_a_plugin_that_cannot_be_used(registry, plugin, name, message):
    plugin("emt_plugin_b", PLUGIN)
    plugin("emt_plugin_broken", "1 / 0")
    plugin("emt_plugin_syntax", "def")
    with pytest.raises(PluginError, match=message):
        registry.get(name)


@pytest.mark.parametrize(
    "name",
    ["os:", ":system", "os.path", "os:system()", "os; x:y", "../os:x", "os:a b", "os:x:y", "1:2", "os:x\n", "oös:x"],
)
def test_only_plain_references_are_imported(registry, monkeypatch, name):
    monkeypatch.setattr("emt.registry.import_module", lambda _: pytest.fail("imported"))
    with pytest.raises(UnknownName):
        registry.get(name)


def test_installed_plugins_are_listed_without_import(registry, plugin, monkeypatch):
    plugin("emt_plugin_c", PLUGIN)
    points = [
        metadata.EntryPoint("third", "emt_plugin_c:Mine [extra]", "emt_test.filters"),
        metadata.EntryPoint("feldmann", "emt_plugin_c:Outer.pair", "emt_test.filters"),
        metadata.EntryPoint("twice", "emt_plugin_c:Mine", "emt_test.filters"),
        metadata.EntryPoint("twice", "emt_plugin_c:Outer.pair", "emt_test.filters"),
    ]
    monkeypatch.setattr(metadata, "entry_points", lambda group: [p for p in points if p.group == group])
    assert registry.names() == ("feldmann", "third", "twice", "vb_random_matrix")
    assert registry.builtin() == ("feldmann", "vb_random_matrix")
    assert registry.get("feldmann").settings is Mine
    assert "emt_plugin_c" not in sys.modules
    assert registry.get("third").builder(registry.get("third").settings()) == "built x"
    with pytest.raises(PluginError, match="'twice' is offered by more than one"):
        registry.get("twice")
