"""Findings of the doctor: every one is on the page for users who need help; the doctor itself prints the remedies."""

import ast

from edge_samples import ROOT

PAGE = (ROOT / "docs" / "trouble.md").read_text()


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


def test_each_finding_has_a_row():
    names = {text for call in findings() for text in texts(call.args[0])}
    assert {"link", "noise", "taxel order"} <= names
    rows = {
        name.strip() for line in PAGE.splitlines() if line.startswith("| ") for name in line.split("|")[1].split(",")
    }
    assert names <= rows, names - rows
