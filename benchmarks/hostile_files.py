"""Every file of a folder of hostile inputs with its answer: clear error, accepted, or a defect.

    python benchmarks/hostile_files.py --cases FOLDER [--out build/hostile.json]

A file goes to every reader of its kind (`benchmarks/fuzz.py`), under the name that reader expects; folders with a `COMMAND` are
run as that command, in a process of their own. `good-odometry`, `slam-base` and `cov_*.npz` are solved, and their errors stand
beside those of the odometry. Status 1 with a defect.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
import fuzz
from forked_verbs import Stage, Verb, heavy_imports

PICTURES = {".png", ".ppm", ".pgm", ".jpg", ".tiff", ".webp"}


def read_answers(path: Path, surfaces: list[fuzz.Surface], scratch: Path) -> dict[str, str]:
    """Answer of every reader that takes such a file."""
    data, found = path.read_bytes(), {}
    for surface in surfaces:
        suffix = Path(surface.name).suffix
        if suffix != path.suffix and not {suffix, path.suffix} <= PICTURES:
            continue
        answer = fuzz.judge(surface, data, scratch / "read")
        found[surface.name] = "accepted" if answer is None else (answer and f"DEFECT {answer}") or "clear"
    return found


def run_answer(stage: Stage, arguments: list[str], inputs: Path, name: str) -> str:
    """Run a command of the command line on a copy of its inputs; paths are taken relative to them."""
    given = stage.scratch / name
    shutil.rmtree(given, ignore_errors=True)
    shutil.copytree(inputs, given)
    out = given / "out"
    if "--out" in arguments:
        at = arguments.index("--out")
        arguments = arguments[:at] + arguments[at + 2 :]
    arguments = [str(given / a) if (given / a).exists() else a for a in arguments]
    status = stage.run(Verb(name, tuple(arguments), f"{name}/out"))
    said = stage.said().strip().splitlines() or [""]
    if "Traceback" in stage.said() or status not in (0, 2):
        return f"DEFECT status {status}: {said[-1]}"
    if status == 2:
        return "clear: " + " ".join(line.strip("│╭╮╰╯─ ") for line in said if any(map(str.isalnum, line)))
    summary = json.loads((out / "summary.json").read_text()) if (out / "summary.json").exists() else {}
    text = f"accepted, {summary.get('landmarks')} landmarks" if summary else "accepted"
    before, after = summary.get("before"), summary.get("after")
    if before and after:
        text += f", ATE {before['ate']:.3f} -> {after['ate']:.3f} m"
        if after["ate"] > 1.05 * before["ate"] + 1e-6 and not summary.get("warnings"):
            text = f"DEFECT worse without a word: {text}"
    words = [*summary.get("warnings", []), *summary.get("remarks", [])]
    return text + "".join(f"; {word}" for word in words)


def answers(cases: Path, only: str = "") -> dict[str, str]:
    """Every case and its answer."""
    heavy_imports({"slam", "observe"})
    surfaces, found = fuzz.surfaces(), {}

    def note(name: str, answer: str) -> None:
        found[name] = answer
        print(f"{name:<46} {answer[:400]}", flush=True)

    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder).resolve()
        stage = Stage(scratch)
        for path in sorted(cases.iterdir()):
            if only and only not in path.name:
                continue
            if path.is_file():
                if path.name.startswith("cov_") and (cases / "slam-base").is_dir():
                    shutil.copytree(cases / "slam-base", scratch / "base", dirs_exist_ok=True)
                    shutil.copy(path, scratch / "base" / "covariance.npz")
                    command = "slam --odometry odometry.txt --observations observations.jsonl --truth truth.txt"
                    command += " --odometry-covariance covariance.npz"
                    note(path.name, run_answer(stage, command.split(), scratch / "base", "run"))
                    continue
                for reader, answer in read_answers(path, surfaces, scratch).items():
                    note(f"{path.name} as {reader}", answer)
            elif (path / "COMMAND").is_file():
                note(path.name, run_answer(stage, shlex.split((path / "COMMAND").read_text())[1:], path, "run"))
            elif (path / "odometry.txt").is_file():
                command = "slam --odometry odometry.txt --observations observations.jsonl --truth truth.txt"
                note(path.name, run_answer(stage, command.split(), path, "run"))
            else:
                for file in sorted(path.iterdir()):
                    for reader, answer in read_answers(file, surfaces, scratch).items():
                        note(f"{path.name}/{file.name} as {reader}", answer)
    return found


def main() -> int:
    """Command line: print the table, write it, status 1 with a defect."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--only", default="", help="part of a name")
    parser.add_argument("--out", type=Path, default=Path("build/hostile.json"))
    options = parser.parse_args()
    found = answers(options.cases, options.only)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(found, indent=2) + "\n")
    defects = [name for name, answer in found.items() if answer.startswith("DEFECT")]
    print(f"{len(found)} answers, {len(defects)} defects: {', '.join(defects)}")
    return int(bool(defects))


if __name__ == "__main__":
    sys.exit(main())
