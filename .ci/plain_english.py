"""Check the English of docstrings, comments and shown text: openers, and the words of a house dialect.

    python .ci/plain_english.py [--show]

A docstring opens with an imperative ("Return the newest scan.") or a noun phrase ("Ring buffer of the last K taps.").
One that opens with a relative word, a pronoun or a preposition has no subject, and its reader has to guess one. The
words of the dialect stand for a dozen different things each where the field has a word for every one of them. Text
that a person reads at run time, on the live page or in the documentation may hold none of them.
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

VAGUE = _words("found known given")
"""Words of the dialect that are right in shown text now and then: "no adapter found"."""
SHOWN_DIALECT = (DIALECT - VAGUE) | _words("tell hears doubt doubts judges judging referee pretended mend mended")
SHOWN_PHRASES = (*DIALECT_PHRASES, "in integers")
MOST_VAGUE_PER_1000 = 3.0
SHOWN_ROOTS = ("edge", "firmware_bridge", "train", "export", "examples")
FEWEST_SHOWN_WORDS = 4
ALLOWED = ("empty where it tells none",)
"""Shown text that cannot change: part of a recorded message definition, by which a file is recognised."""


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


def dialect_words(
    text: str, dialect: frozenset[str] = DIALECT, phrases: tuple[str, ...] = DIALECT_PHRASES
) -> Counter[str]:
    """Count the words of the dialect in a text."""
    lowered = re.sub(r"in[ _]doubt", "", text.lower())  # the name of a state, and English
    words = Counter(word for word in _WORD.findall(lowered) if word in dialect)
    return words + Counter({phrase: len(re.findall(rf"\b{phrase}\b", lowered)) for phrase in phrases})


def strings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line number and text of every string of some words that is not a docstring, formatted values left out."""
    apart = {id(node) for part in ast.walk(tree) if isinstance(part, ast.JoinedStr) for node in part.values}
    apart |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        values = node.values if isinstance(node, ast.JoinedStr) else [] if id(node) in apart else [node]
        parts = [value.value for value in values if isinstance(value, ast.Constant) and isinstance(value.value, str)]
        text = "_".join(parts)
        if len(_WORD.findall(text)) >= FEWEST_SHOWN_WORDS:
            yield getattr(node, "lineno", 0), text


def page_text(source: str, suffix: str) -> str:
    """Return what a page's source shows: text and labels of HTML, strings of a script."""
    if suffix == ".html":
        return " ".join([*re.findall(r'aria-label="([^"]*)"', source), re.sub(r"<[^>]*>", " ", source)])
    script = re.sub(r"^\s*(?://|/?\*).*|\s// .*", "", source, flags=re.MULTILINE)
    return " ".join(re.sub(r"\$\{[^}]*\}|`", " ", text) for text in re.findall(r'"[^"\n]*"|`[^`]*`', script))


def prose(markdown: str) -> str:
    """Return the text of a Markdown page without its code."""
    return re.sub(
        r"^ *```.*?^ *```|`[^`\n]*`|^ {4,}\S[^\n]*|\]\([^)]*\)", " ", markdown, flags=re.MULTILINE | re.DOTALL
    )


def shown_texts() -> Iterator[tuple[str, str]]:
    """Yield place and text of all that a person reads: messages and help, the live page, the documentation."""
    listed = subprocess.run(["git", "ls-files"], capture_output=True, check=True, text=True).stdout.splitlines()
    for path in filter(Path.is_file, map(Path, listed)):
        if path.parts[0] in SHOWN_ROOTS and path.suffix == ".py":
            for line, text in strings(ast.parse(path.read_text(encoding="utf-8"))):
                yield f"{path}:{line}", text
        elif path.parts[0] == "edge" and path.suffix in (".html", ".js"):
            yield str(path), page_text(path.read_text(encoding="utf-8"), path.suffix)
        elif path.suffix == ".md" and path.parts[0] in ("docs", "README.md"):
            yield str(path), prose(path.read_text(encoding="utf-8"))


def shown_dialect(text: str) -> Counter[str]:
    """Count the words of the dialect in shown text; text between backticks is a name."""
    for allowed in ALLOWED:
        text = text.replace(allowed, "")
    return dialect_words(re.sub(r"`[^`\n]*`", "", text), SHOWN_DIALECT, SHOWN_PHRASES)


def check_shown(*, show: bool) -> bool:
    """Print the words of the dialect in shown text; True if there are too many."""
    broken = words = 0
    vague: Counter[str] = Counter()
    for place, text in shown_texts():
        words += len(_WORD.findall(text))
        vague += dialect_words(text, VAGUE, ())
        if found := shown_dialect(text):
            broken += found.total()
            print(f"{place}: shown text has {', '.join(found)}")
        if show and (found := dialect_words(text, VAGUE, ())):
            print(f"{place}: {', '.join(found)}: {' '.join(text.split())[:150]}")
    per_1000 = 1000 * vague.total() / max(words, 1)
    print(
        f"{words} words of shown text: {broken} of the dialect (0 may be), {per_1000:.1f} vague ones in 1000 "
        f"(at most {MOST_VAGUE_PER_1000:g}): {', '.join(f'{word} {count}' for word, count in vague.most_common())}"
    )
    return broken > 0 or per_1000 > MOST_VAGUE_PER_1000


def main() -> int:
    """Print what breaks the rules; 1 if anything does."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
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
    too_many = check_shown(show=args.show) if not args.paths else False
    return int(too_many or bool(banned) or headless_share > MOST_HEADLESS_SHARE or per_1000 > MOST_DIALECT_PER_1000)


if __name__ == "__main__":
    sys.exit(main())
