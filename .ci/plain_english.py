"""Check the English of docstrings and comments: how they open, and how many words of a house dialect they hold.

    python .ci/plain_english.py [--show]

A docstring opens with an imperative ("Return the newest scan.") or a noun phrase ("Ring buffer of the last K taps.").
One that opens with a relative word, a pronoun or a preposition has no subject, and its reader has to guess one. The
words of the dialect stand for a dozen different things each where the field has a word for every one of them.
"""

import argparse
import ast
import io
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

_WORD = re.compile(r"[A-Za-z][A-Za-z'-]*")


def _words(text: str) -> frozenset[str]:
    return frozenset(_WORD.findall(text))


BANNED = _words("what how of which whose who whoever whom that")
HEADLESS = BANNED | _words(
    """
    where when why whether if than then so as by in on at from with without for over under between before after behind
    beside beyond until since through into onto to it its they them their there those these this such does is are has
    have was were been neither nor not also only even
    """
)
DIALECT = _words("told tells said says say heard hear found known given anew behind whoever beside judge judged")
DIALECT_PHRASES = ("none is",)
MOST_HEADLESS_SHARE = 0.02
MOST_DIALECT_PER_1000 = 10.0


def docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line number and text of every docstring, those of constants and attributes included."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            if not isinstance(statement, ast.Expr) or not isinstance(statement.value, ast.Constant):
                continue
            if isinstance(statement.value.value, str):
                yield statement.lineno, statement.value.value.strip()


def comments(source: str) -> Iterator[str]:
    """Yield the text of every comment."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string.lstrip("#! ")


def opener(text: str) -> str:
    """Return the first word of a text in lower case, empty where it begins with a name, a number or a sign."""
    first = re.match(r"[A-Za-z]+\b", text)
    return first.group().lower() if first else ""


def dialect_words(text: str) -> Counter[str]:
    """Count the words of the dialect in a text."""
    lowered = text.lower()
    words = Counter(word for word in _WORD.findall(lowered) if word in DIALECT)
    return words + Counter({phrase: len(re.findall(rf"\b{phrase}\b", lowered)) for phrase in DIALECT_PHRASES})


def main() -> int:
    """Print what breaks the rules; 1 if anything does."""
    parser = argparse.ArgumentParser(description="Check the English of docstrings and comments.")
    parser.add_argument("paths", nargs="*", help="files or folders (all that git tracks)")
    parser.add_argument("--show", action="store_true", help="print every headless opener and every word of the dialect")
    args = parser.parse_args()
    listed = subprocess.run(
        ["git", "ls-files", "--", *(args.paths or ["*.py"])], capture_output=True, check=True, text=True
    )
    banned: list[str] = []
    headless: list[str] = []
    used: Counter[str] = Counter()
    openers = words = 0
    for name in filter(lambda name: name.endswith(".py") and Path(name).is_file(), listed.stdout.splitlines()):
        source = Path(name).read_text(encoding="utf-8")
        texts = list(docstrings(ast.parse(source)))
        openers += len(texts)
        for line, text in texts:
            shown = f"{name}:{line}: {text.splitlines()[0] if text else ''}"
            word = opener(text)
            if word in BANNED:
                banned.append(shown)
            if word in HEADLESS:
                headless.append(shown)
        for text in (*(text for _, text in texts), *comments(source)):
            found = dialect_words(text)
            used += found
            words += len(_WORD.findall(text))
            if args.show and found:
                print(f"{name}: {', '.join(found)}: {' '.join(text.split())[:150]}")
    headless_share, per_1000 = len(headless) / max(openers, 1), 1000 * used.total() / max(words, 1)
    for shown in headless if args.show else banned[:20]:
        print(shown)
    print(
        f"{openers} docstrings: {len(banned)} open with a banned word (0 may), {headless_share:.1%} are headless "
        f"(at most {MOST_HEADLESS_SHARE:.0%}); {per_1000:.1f} words of the dialect in 1000 "
        f"(at most {MOST_DIALECT_PER_1000:g}): {', '.join(f'{word} {count}' for word, count in used.most_common(8))}"
    )
    return int(bool(banned) or headless_share > MOST_HEADLESS_SHARE or per_1000 > MOST_DIALECT_PER_1000)


if __name__ == "__main__":
    sys.exit(main())
