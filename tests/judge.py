"""Asks meshcheck about a mesh and holds its answer against claims; used by the end-to-end tests.

    python3 tests/judge.py MESH.ply [meshcheck options] -- CLAIM...

A claim is `name<=number`, `name>=number` or `name==number`; names with a dot reach inside: `to_ref.p99<=0.0125`.
The five zero counts of a sound mesh are always claimed. Prints one `note:` line with what the claims name.
"""
import json
import re
import subprocess
import sys

SOUND = ["t_junctions==0", "nonmanifold_edges==0", "flipped_edges==0", "degenerate==0", "duplicate==0"]
TOOL = "../shared/tools/meshcheck"


def value(answer, name):
    for part in name.split("."):
        answer = answer[part]
    return answer


def broken(answer, claims):
    """The claims that do not hold, each as a sentence."""
    out = []
    for claim in claims:
        name, relation, limit = re.fullmatch(r"([\w.]+)(<=|>=|==)(.+)", claim).groups()
        got, limit = value(answer, name), float(limit)
        holds = {"<=": got <= limit, ">=": got >= limit, "==": got == limit}[relation]
        if not holds:
            out.append(f"{name} is {got}, wanted {relation} {limit:g}")
    return out


def ask(arguments):
    return json.loads(subprocess.run([TOOL, *arguments], check=True, capture_output=True, text=True).stdout)


def main():
    split = sys.argv.index("--")
    arguments, claims = sys.argv[1:split], sys.argv[split + 1:]
    answer = ask(arguments)
    wrong = broken(answer, SOUND + claims)
    shown = ", ".join(f"{c.split('<')[0].split('>')[0].split('=')[0]} {value(answer, re.match(r'[^<>=]+', c)[0]):g}" for c in claims)
    print(f"note: {arguments[0].rsplit('/', 1)[-1]}: {answer['faces']} faces, {shown}")
    for sentence in wrong:
        print(f"{arguments[0]}: {sentence}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
