"""The commands that the READMEs show: the real parsers take them, and what they read was made."""

import re
import shlex
from pathlib import Path

import pytest

from uncertain_place_recognition import calibrate, evaluate
from uncertain_place_recognition.datasets import make_runs
from uncertain_place_recognition.training import arguments as training

_ROOT = Path(__file__).parents[2]
_READMES = ('README.md', 'uncertain_place_recognition/README.md')
_PARSERS = {
    'make_submap_runs': make_runs._parser,
    'train_place_recognition': training.parser,
    'calibrate_place_recognition': calibrate._parser,
    'evaluate_place_recognition': evaluate._parser,
}


def shown(readme):
    """Return the words of every command of this package in the bash blocks of a README, and cp."""
    text = (_ROOT / readme).read_text()
    found = []
    for block in re.findall(r'```bash\n(.*?)```', text, re.DOTALL):
        for line in block.replace('\\\n', ' ').splitlines():
            words = shlex.split(line, comments=True)
            if words and (words[0] in _PARSERS or words[0] == 'cp'):
                found.append(words)
    return found


@pytest.mark.parametrize('readme', _READMES)
def test_the_parsers_take_every_command(readme, capsys):
    seen = set()
    for name, *given in shown(readme):
        if name == 'cp':
            continue
        try:
            _PARSERS[name]().parse_args(given)
        except SystemExit as stop:
            if stop.code:
                pytest.fail(f'{name} {shlex.join(given)}: {capsys.readouterr().err}')
        seen.add(name)
    assert seen == set(_PARSERS)


@pytest.mark.parametrize('readme', _READMES)
def test_what_a_command_reads_another_one_made(readme):
    made = set()
    for name, *given in shown(readme):
        if name == 'cp':
            source, target = (word.rstrip('/') for word in given)
            assert source in made and target in made
            continue
        if '--help' in given:
            continue
        read = _PARSERS[name]().parse_args(given)
        for path in _inputs(name, read):
            known = str(path.parent if path.suffix == '.npz' else path)
            assert known in made, f'{name} reads {path}, which no command before made'
        out = str(read.out)
        made.add(out)
        if getattr(read, 'role', '') == 'ensemble':
            made.add(f'{out}/teacher')
        if name == 'calibrate_place_recognition':
            made.add(f'{out}/calibration.json')


@pytest.mark.parametrize('readme', _READMES)
def test_an_ensemble_that_the_node_gets_has_its_calibration(readme):
    text = (_ROOT / readme).read_text()
    copied = {words[2].rstrip('/') for words in shown(readme) if words[0] == 'cp'}
    used = set(re.findall(r'^place_recognition .*-p weights:=(\S+)', text, re.MULTILINE))
    assert used <= copied


def _inputs(name, read):
    if name == 'make_submap_runs':
        return []
    if name == 'train_place_recognition':
        paths = [*getattr(read, 'runs', []), *read.validation, *getattr(read, 'files', [])]
        return [*paths, *([read.teacher] if getattr(read, 'teacher', None) else [])]
    ensembles = [Path(text.partition('=')[2] or text) for text in read.ensemble]
    paths = [*read.runs, *getattr(read, 'database', []), *getattr(read, 'queries', [])]
    calibration = getattr(read, 'calibration', None)
    return [*paths, *ensembles, *([calibration] if calibration else [])]
