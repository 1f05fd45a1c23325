"""The structure stays as short as it is: `python benchmark/structure.py` prints the figures."""

from __future__ import annotations

import ast
from collections import Counter
import inspect
from pathlib import Path
import re

import pytest

from slam_observer_ros.filter import core

CHECKOUT = Path(__file__).resolve().parents[2]
BENCHMARK = CHECKOUT / 'benchmark'
PACKAGE = CHECKOUT / 'slam_observer_ros'

VAGUE = re.compile(
    r'(?<![a-z])(tells?|told|telling|anew|fate|befell|lacks?|meets?)(?![a-z])', re.IGNORECASE
)
"""Words for which the field has better ones."""


@pytest.fixture(name='structure')
def fixture_structure(monkeypatch):
    if not BENCHMARK.is_dir():
        pytest.skip('the benchmark is not installed')
    monkeypatch.syspath_prepend(str(BENCHMARK))
    import structure

    return structure


def sources():
    return [*PACKAGE.rglob('*.py'), *(CHECKOUT / 'docs').glob('*.md'), CHECKOUT / 'README.md']


def test_folders_show_the_architecture(structure):
    assert len(structure.modules()) <= 158
    assert len(structure.loose_modules()) <= 5
    assert structure.layers() <= 12
    assert len(structure.longest_chain()) <= 18


def test_a_step_with_ids_takes_no_more_calls_than_it_did(structure):
    if core.COMPILED is None:
        pytest.skip('the core is not compiled; the reference in numpy takes twice as many calls')
    step = structure.traced_step()
    assert len(step.modules) <= 24
    assert step.functions <= 88
    assert step.changes <= 52
    assert step.depth <= 12


def test_one_function_reads_as_the_method_a_step_is_its_calls(structure):
    """The equations stand beside its lines, and pages send a reader there."""
    called = structure.traced_step().method
    assert called == [
        '_advance',
        'judge_slip',
        'associate',
        'observe',
        'update_landmarks',
        'append',
        'follow_moved',
    ]
    source = inspect.getsource(structure.step)
    assert all(number in source for number in ('(27)', '(28)–(31)', '(19)'))
    assert source.count('\n') <= 25
    for page in (CHECKOUT / 'docs' / 'architecture.md', CHECKOUT / 'CONTRIBUTING.md'):
        assert '`step` in `tracking/step.py`' in page.read_text(encoding='utf-8')


def test_the_filter_knows_no_event_and_no_settings_class(structure):
    """It is the method: numbers come in as arrays and as the figures of ``models/``."""
    imported = {
        (module, name)
        for module, names in structure.imports().items()
        if module.startswith('filter')
        for name in names
        if name.partition('.')[0] in ('events', 'settings', 'estimates')
    }
    assert imported == set()


def test_a_velocity_takes_no_more_calls_than_it_did(structure):
    velocity = structure.traced_velocity()
    assert velocity.functions <= 18
    assert len(velocity.modules) <= 5


def test_docstrings_are_a_fifth_of_all_lines_at_most(structure):
    docstrings, lines = structure.docstring_lines()
    assert docstrings <= 0.2 * lines


def nodes_of(*folders, holding=re.compile('')):
    """Return what the syntax trees of sources have, of those alone whose text holds a pattern."""
    paths = [path for folder in folders for path in folder.rglob('*.py')]
    texts = [(path, path.read_text()) for path in paths]
    trees = [(path, ast.parse(text)) for path, text in texts if holding.search(text)]
    return [(path, node) for path, tree in trees for node in ast.walk(tree)]


def test_no_two_classes_have_one_name():
    names = Counter(n.name for _, n in nodes_of(PACKAGE) if isinstance(n, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []


def test_nodes_hand_over_numbers_and_word_no_finding():
    """What is wrong with a node is judged by ``runs/``, in the words of ``common/findings.py``."""
    called = [
        (path.name, node.func.id)
        for path, node in nodes_of(PACKAGE / 'nodes')
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        if node.func.id in ('found', 'Finding')
    ]
    assert called == [('ros_node.py', 'found')], 'but for what is logged as it comes'


def test_docstrings_messages_and_pages_name_their_subjects():
    """In the package all texts; in what is not installed, those that describe something."""
    folders = [CHECKOUT / name for name in ('benchmark', 'demo', 'scripts', 'test')]
    stand_ins = re.compile(r'\b(that|those)\s+of\b')
    described = [
        (path, node.value)
        for path, node in nodes_of(*folders, holding=stand_ins)
        if isinstance(node, ast.Expr)
    ]
    found = [
        f'{path.name}: {node.value}'
        for path, node in [*nodes_of(PACKAGE, holding=stand_ins), *described]
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        if stand_ins.search(node.value)
    ]
    pages = [*CHECKOUT.glob('docs/*.md'), CHECKOUT / 'README.md']
    assert found + [page.name for page in pages if stand_ins.search(page.read_text())] == []


def test_gains_are_distinguished_by_what_they_have_not_by_name():
    for path in PACKAGE.rglob('*.py'):
        text = path.read_text(encoding='utf-8')
        assert not re.search(r'isinstance\([^)]*Gains\)', text), path
        assert not re.search(r"[!=]= '(riccati|constant)'", text), path


def test_what_is_estimated_is_changed_in_place():
    replaced = re.compile(r'observer\.(A|a|u|y_ref|reference_pose|covariance)\b *=[^=]')
    for path in PACKAGE.rglob('*.py'):
        assert not replaced.search(path.read_text(encoding='utf-8')), path


def test_one_module_knows_the_coordinates_of_the_errors():
    """But for the step, which spells them out beside the equations."""
    knows = re.compile(r'axes\.(turn|output)_matrix')
    known = list((PACKAGE / 'filter' / 'riccati').rglob('*.py'))
    assert len(known) > 5
    for path in known:
        assert not knows.search(path.read_text(encoding='utf-8')), path


def test_what_a_replay_is_asked_for_is_a_request_and_no_faked_command_line():
    for path in PACKAGE.rglob('*.py'):
        assert 'argparse.Namespace(' not in path.read_text(encoding='utf-8'), path
    rooms = list((PACKAGE / 'cli').glob('replay*.py'))
    assert 1 <= len(rooms) <= 6


def test_settings_are_changed_in_one_place():
    definitions = [
        path
        for path in PACKAGE.rglob('*.py')
        for _ in re.findall(r'def change_settings\(', path.read_text(encoding='utf-8'))
    ]
    assert len(definitions) == 1


def test_words_are_those_of_the_field():
    found = [
        f'{path.name}:{number}: {line.strip()}'
        for path in sources()
        for number, line in enumerate(path.read_text(encoding='utf-8').splitlines(), 1)
        if VAGUE.search(line)
    ]
    assert not found
