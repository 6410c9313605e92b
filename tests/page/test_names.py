"""Names as sub-assemblies with counts, and a search that finds each word."""

from hapticdb.page.scene.names import found_ids, tree_of

NAMES = {
    4: "body/door/handle",
    2: "body/hood",
    9: "engine/piston 1",
    7: "body/door/glass",
    1: "jack",
}


def test_the_tree_has_each_object_once_with_counts() -> None:
    tree = tree_of(NAMES)
    assert tree.count == 5
    assert [(b.name, b.count) for b in tree.branches] == [("body", 3), ("engine", 1)]
    door = tree.branches[0].branches[0]
    assert (door.path, door.ids, tree.ids) == ("body/door", [7, 4], [1])
    assert sorted(tree.all_ids()) == sorted(NAMES)


def test_a_search_holds_each_word_in_any_case_and_ranks_last_elements_first() -> None:
    assert found_ids(NAMES, "DOOR") == [7, 4]
    assert found_ids(NAMES, "h") == [4, 2]
    assert found_ids(NAMES, "body gl") == [7]
    assert found_ids(NAMES, "  ") == []
    assert found_ids(NAMES, "piston 1") == [9]
