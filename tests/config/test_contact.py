"""Whether the arm must touch the board, if the experiment does not say so."""

import pytest

from cloudrc.config.load import load_experiment


@pytest.mark.parametrize(
    ("name", "settings", "contact"),
    [
        ("paper", [], True),
        ("paper", ["world.scene=empty", "mission=hover"], False),
        ("steps", [], False),
        ("hover", [], False),
        ("hover", ["criteria.contact=true"], True),
        ("paper", ["criteria.contact=false"], False),
    ],
)
def test_contact_is_required_only_where_the_scene_has_a_board(name, settings, contact):
    assert load_experiment(name, settings).criteria.contact is contact
