"""The command: help, errors in one line, exit codes."""

from __future__ import annotations

import subprocess
import sys
import types

import pytest

from vli_bringup import cli
from vli_common.errors import InputError


@pytest.fixture
def command(monkeypatch):
    """Return a function that installs ``vli probe`` with a given body."""

    def install(body):
        module = types.SimpleNamespace(add_arguments=lambda parser: parser.add_argument("--depth", type=int, default=0), run=body)
        monkeypatch.setitem(sys.modules, "probe_command", module)
        monkeypatch.setitem(cli.COMMANDS, "probe", ("probe_command", "a command of this test"))

    return install


def fail(error):
    def body(args):
        raise error

    return body


def test_a_command_gets_its_arguments_and_returns_the_exit_code(command):
    seen = []
    command(lambda args: seen.append((args.depth, args.started_s > 0)) or 1)
    assert cli.main(["probe", "--depth", "3"]) == 1
    assert seen == [(3, True)]


def test_an_error_is_one_line_on_stderr_and_exit_code_2(command, capsys):
    command(fail(InputError("bag 'x' is broken:\n  bad magic")))
    assert cli.main(["probe"]) == 2
    assert capsys.readouterr() == ("", "vli: bag 'x' is broken: bad magic\n")


def test_an_interrupt_is_no_traceback(command, capsys):
    command(fail(KeyboardInterrupt()))
    assert cli.main(["probe"]) == 130
    assert capsys.readouterr().err == "vli: interrupted\n"


def test_an_error_of_the_program_itself_is_not_hidden(command):
    command(fail(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        cli.main(["probe"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "vli: the following arguments are required: COMMAND; see 'vli --help'"),
        (["scan"], "vli: argument COMMAND: invalid choice: 'scan'"),
        (["probe", "--depth", "x"], "vli probe: argument --depth: invalid int value: 'x'; see 'vli probe --help'"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(command, capsys, arguments, said):
    command(lambda args: 0)
    with pytest.raises(SystemExit) as error:
        cli.main(arguments)
    line = capsys.readouterr().err
    assert error.value.code == 2
    assert line.startswith(said)
    assert line.count("\n") == 1


def test_help_lists_every_command_without_importing_any():
    code = """
import sys
from vli_bringup import cli
try:
    cli.main(["--help"])
finally:
    print("numpy" in sys.modules, file=sys.stderr)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    listed = {line.split()[0] for line in result.stdout.splitlines() if line.startswith("    ")}
    assert set(cli.COMMANDS) <= listed
    assert result.stderr.strip() == "False"


def test_a_reader_of_stdout_that_leaves_is_no_error():
    code = """
import sys, types
from vli_bringup import cli
sys.modules["probe"] = types.SimpleNamespace(add_arguments=lambda parser: None, run=lambda args: print("x" * 10**7) or 0)
cli.COMMANDS["probe"] = ("probe", "talks a lot")
sys.exit(cli.main(["probe"]))
"""
    script = 'set -o pipefail; "$0" -c "$1" | head -c 1'
    result = subprocess.run(["bash", "-c", script, sys.executable, code], capture_output=True, text=True, check=True)
    assert (result.stdout, result.stderr) == ("x", "")
