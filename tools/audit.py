"""Known vulnerabilities of what is installed, by pip-audit; says so where the service cannot be reached.

    python tools/audit.py [PACKAGE …]

Without names all packages of the environment are looked up, dependencies of dependencies too.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path


def main(names: list[str]) -> int:
    with tempfile.TemporaryDirectory() as folder:
        listed = Path(folder, "requirements.txt")
        listed.write_text("".join(f"{name}=={version(name)}\n" for name in names))
        given = ["-r", str(listed), "--no-deps", "--disable-pip"] if names else ["--local", "--skip-editable"]
        command = [sys.executable, "-m", "pip_audit", *given, "--format", "json", "--progress-spinner", "off"]
        ran = subprocess.run(command, capture_output=True, text=True)
    try:
        packages = json.loads(ran.stdout)["dependencies"]
    except (ValueError, KeyError):
        print(f"not checked: the vulnerability service cannot be reached ({ran.stderr.strip().splitlines()[-1:]})")
        return 0
    looked_up = [package for package in packages if "skip_reason" not in package]
    if not looked_up:
        print("not checked: the vulnerability service knows none of the packages; is the network allowed?")
        return 0
    bad = [(package, each) for package in looked_up for each in package["vulns"]]
    for package, each in bad:
        print(
            f"{package['name']} {package['version']}: {each['id']}, fixed in {', '.join(each['fix_versions']) or '–'}"
        )
    print(f"{len(looked_up)} packages looked up, {len(packages) - len(looked_up)} skipped, {len(bad)} vulnerabilities")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
