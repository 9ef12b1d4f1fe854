"""Findings of the doctor and their remedies: every one is on the page for users who need help."""

import ast

from edge_samples import ROOT

PAGE = (ROOT / "docs" / "trouble.md").read_text()
REMEDIES = {"remedy", "off", "busy", "_LOSS_REMEDY", "_OVERLOADED", "_AGAIN"}
WORDS = " ".join(PAGE.replace("`", "").replace("\\|", "|").split())


def trees() -> list[ast.AST]:
    return [ast.parse(path.read_text()) for path in sorted((ROOT / "edge" / "doctor").glob("*.py"))]


def findings() -> list[ast.Call]:
    return [
        node
        for tree in trees()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Finding"
    ]


def texts(node: ast.AST) -> list[str]:
    return [one.value for one in ast.walk(node) if isinstance(one, ast.Constant) and isinstance(one.value, str)]


def remedies() -> set[str]:
    """Return the remedies, as far as they do not depend on measurements."""
    said = {text for call in findings() for one in call.args[4:5] for text in texts(one)}
    assigned = [node for tree in trees() for node in ast.walk(tree) if isinstance(node, (ast.Assign, ast.AnnAssign))]
    for node in assigned:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if node.value is not None and {target.id for target in targets if isinstance(target, ast.Name)} & REMEDIES:
            said |= set(texts(node.value))
    return {text.strip(" ;,") for text in said if len(text) > 20}


def test_each_finding_has_a_row():
    names = {text for call in findings() for text in texts(call.args[0])}
    assert {"link", "noise", "taxel order"} <= names
    rows = {one.strip() for line in PAGE.splitlines() if line.startswith("| ") for one in line.split("|")[1].split(",")}
    assert names <= rows, names - rows


def test_what_is_to_be_done_can_be_looked_up_as_it_was_said():
    said = remedies()
    assert len(said) > 30
    assert [one for one in sorted(said) if one not in WORDS] == []
