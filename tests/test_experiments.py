from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from torchrl_caiac.experiments import keep_settings, write_json

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.sampled_from([0.5, 1.0, "a", ""]),
    lambda x: st.lists(x, max_size=2) | st.dictionaries(st.sampled_from("ab"), x),
    max_leaves=4,
)
mappings = st.dictionaries(st.sampled_from("abc"), values, max_size=3)


class TestKeepSettings:
    @settings(max_examples=60, deadline=None)
    @given(mappings, mappings)
    def test_only_the_same_again(self, first, second):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "settings.json"
            keep_settings(first, path)
            keep_settings(OmegaConf.create(first), path)
            kept = path.read_bytes()
            if first == second:
                keep_settings(second, path)
            else:
                names = [
                    k
                    for k in sorted({*first, *second})
                    if k not in first or k not in second or first[k] != second[k]
                ]
                with pytest.raises(ValueError) as error:
                    keep_settings(second, path)
                assert f"({names} differ)" in str(error.value)
            assert path.read_bytes() == kept

    def test_tuples_are_lists(self, tmp_path):
        keep_settings({"sizes": (3, 4)}, tmp_path / "new" / "a.json")
        keep_settings({"sizes": [3, 4]}, tmp_path / "new" / "a.json")
        with pytest.raises(ValueError, match=r"new holds results of other settings"):
            keep_settings({"sizes": [4, 3]}, tmp_path / "new" / "a.json")

    def test_foreign_files(self, tmp_path):
        path = tmp_path / "a.json"
        path.write_text("[1, 2]")
        with pytest.raises(ValueError, match=r"\(all differ\)"):
            keep_settings({"a": 1}, path)
        write_json(path, {"a": 1})
        for content in (path.read_bytes()[:-4], b"", b"\xff\xfe"):
            path.write_bytes(content)
            with pytest.raises(ValueError, match=r"a\.json holds no settings"):
                keep_settings({"a": 1}, path)
            assert path.read_bytes() == content
