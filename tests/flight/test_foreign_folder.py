# SPDX-License-Identifier: Apache-2.0

"""`cloudrc sweep run --out` does not overwrite what a user has written."""

import pytest

SWEEP = "# mine\nexperiment: paper\nseeds: 1\ngrid: {link.uplink.loss: [0.0]}\n"


@pytest.mark.parametrize("shard", ["", " --shard 1/2"])
def test_a_folder_that_is_not_of_a_sweep_is_refused_and_kept(tmp_path, refused, shard):
    grid, folder = tmp_path / "grid.yaml", tmp_path / "folder"
    folder.mkdir()
    grid.write_text(SWEEP)
    (folder / "sweep.yaml").write_text(SWEEP)
    (folder / "table.csv").write_text("a\n")
    assert "already exists; name a new folder" in refused(
        f"sweep run{shard}", grid, "--out", folder
    )
    assert (folder / "sweep.yaml").read_text() == SWEEP
    assert (folder / "table.csv").read_text() == "a\n"
    assert len([*folder.iterdir()]) == 2
