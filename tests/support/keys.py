# SPDX-License-Identifier: Apache-2.0

"""The keys of an experiment or a profile, as their JSON schemas describe them."""

from cloudrc.config.keys import forms, keys_of


def forms_of(model):
    """Return path -> JSON schemas of the forms that a key may have; "0" is an entry of a list."""
    defined = model.model_json_schema()
    return {
        ".".join(path).replace("[]", ".0"): [*forms(defined, part)]
        for path, part in keys_of(defined, defined)
    }


def limits_of(form):
    """Return the limits of a number in a JSON schema, as arguments of a Quantity."""
    names = {"minimum": "ge", "exclusiveMinimum": "gt", "maximum": "le"}
    limits = {names[key]: form[key] for key in names if key in form}
    if "exclusiveMaximum" in form:
        limits["le"] = form["exclusiveMaximum"] - 1
    return limits
