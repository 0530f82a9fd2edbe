"""Examples: which there are, and copies that stand on their own."""

from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.experiment import examples
from hilctl.experiment.devices import shipped_profiles
from hilctl.experiment.examples import copy_example, examples_folder, shipped_examples
from hilctl.experiment.load import load_experiment
from hilctl_drivers.profile import load_profile

CONFIGS = Path(__file__).parents[3] / "configs"


def test_a_checkout_has_them_in_configs(tmp_path, monkeypatch):
    assert examples_folder() == CONFIGS
    installed = tmp_path / "hilctl" / "examples"
    installed.mkdir(parents=True)
    monkeypatch.setattr(examples, "_PACKAGE", tmp_path / "hilctl")
    assert examples_folder() == installed


def test_each_says_what_it_is_for():
    found = shipped_examples(CONFIGS)
    assert {example.name for example in found} >= {"demo", "models/terfenol_staged"}
    assert not [example.name for example in found if not example.description]
    paths = {example.path for example in found}
    files = {path for path in CONFIGS.rglob("*.*") if path.suffix != ".md"}
    profiles = {Path(path) for path in shipped_profiles().values()}
    assert paths == (files - {CONFIGS / "schema.json"}) | profiles


@pytest.mark.parametrize(("name", "files"), [
    ("layouts/foxglove", ["layouts/foxglove.json"]),
    ("hilctl@", ["hilctl@.service"]),
    ("layouts/plotjuggler", ["layouts/plotjuggler.xml"]),
    ("profiles/labjack_t7", ["profiles/labjack_t7.yaml", "profiles/schema.json"]),
])  # fmt: skip
def test_layouts_and_profiles_are_copied_too(tmp_path, name, files):
    assert copy_example(name, tmp_path, CONFIGS) == tuple(tmp_path / file for file in files)
    if name.startswith("profiles"):
        assert load_profile(str(tmp_path / files[0])).outputs


@pytest.mark.parametrize("name", ["demo", "modbus_adam_6224"])
def test_a_copy_stands_on_its_own(tmp_path, name):
    own = tmp_path / "new" / "folder"
    first, *others = copy_example(name, own, CONFIGS)
    assert first == own / f"{name}.yaml"
    assert own / "schema.json" in others
    assert load_experiment(first).config.name == name


def test_a_copy_that_is_there_stays_and_one_that_was_changed_is_not_written_over(tmp_path):
    first, model, schema = copy_example("demo", tmp_path, CONFIGS)
    assert copy_example("demo", tmp_path, CONFIGS) == (first, model, schema)
    schema.unlink()
    model.write_text("mine")
    with pytest.raises(InputError, match=r"terfenol_staged.yaml"):
        copy_example("demo", tmp_path, CONFIGS)
    assert model.read_text() == "mine"
    assert not schema.exists()


def test_what_can_not_be_had_is_said(tmp_path):
    with pytest.raises(InputError, match=r"'demox' .*'demo'"):
        copy_example("demox", tmp_path, CONFIGS)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="Not a directory"):
        copy_example("demo", tmp_path / "file" / "there", CONFIGS)


def test_examples_may_name_each_other(tmp_path):
    folder = tmp_path / "shipped"
    (folder / "models").mkdir(parents=True)
    (folder / "a.yaml").write_text("base: b.yaml\nothers: [models/m.yaml, {deep: models/m.yaml}]\n")
    (folder / "b.yaml").write_text("model: models/m.yaml\n")
    (folder / "models" / "m.yaml").write_text("model: {kind: ppi}\n")
    copies = copy_example("a", tmp_path / "own", folder)
    names = [path.relative_to(tmp_path / "own").as_posix() for path in copies]
    assert names == ["a.yaml", "b.yaml", "models/m.yaml"]
