"""The checker of the tree's English sees the words it is meant for, where a person reads them and nowhere else."""

import ast
import importlib.util

import pytest
from edge_samples import ROOT

_SPEC = importlib.util.spec_from_file_location("plain_english", ROOT / ".ci" / "plain_english.py")
assert _SPEC is not None and _SPEC.loader is not None
plain_english = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(plain_english)


def shown(source):
    return [text for _, text in plain_english.strings(ast.parse(source))]


@pytest.mark.parametrize(
    "planted", ["no scan was heard yet", "no sensor is told apart", "If none is dead, measured anew."]
)
def test_a_planted_word_of_the_dialect_is_seen_in_shown_text(planted):
    assert shown(f"raise UsageError({planted!r})") == [planted]
    assert plain_english.shown_dialect(planted)


@pytest.mark.parametrize(
    "right", ["no adapter found: plug one in", "keys `told`, `doubt` and `error`, of equal length"]
)
def test_words_of_the_field_and_names_pass(right):
    assert not plain_english.shown_dialect(right)


def test_strings_are_whole_sentences_without_docstrings_and_values():
    source = '"""Heard by nobody at all."""\nsay(f"no scan of {name} in {told} s")\nkinds = ("lost", "given_up")\n'
    assert shown(source) == ["no scan of _ in _ s"]


def test_a_page_shows_its_text_its_labels_and_the_strings_of_its_script():
    html = '<p id="told" aria-label="newest scan">What was heard</p>'
    assert set(plain_english.shown_dialect(plain_english.page_text(html, ".html"))) == {"heard"}
    assert "newest scan" in plain_english.page_text(html, ".html")
    script = 'const told = 1; // heard here\nsay(`doubt of ${told}`, "beside it");\n'
    assert set(plain_english.shown_dialect(plain_english.page_text(script, ".js"))) == {"doubt", "beside"}


def test_prose_of_a_page_leaves_out_code():
    text = plain_english.prose(
        "Text beside code:\n\n```sh\nsay told\n```\n\n    heard\n\nand `anew` after it, said last.\n"
    )
    assert set(plain_english.shown_dialect(text)) == {"beside", "said"}
