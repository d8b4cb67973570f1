"""Labels keep clear of marks and of each other as long as there is room."""

from __future__ import annotations

from service.offline.benchmark.placing import free_place

INSIDE = (0.0, 0.0, 400.0, 300.0)
SIZE = (60.0, 12.0)


def overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def test_ten_marks_close_together_have_ten_labels_apart() -> None:
    places = [(200.0 + 7 * i, 150.0 - 5 * i) for i in range(10)]
    taken: list[tuple[float, float, float, float]] = [
        (x - 8, y - 8, x + 8, y + 8) for x, y in places
    ]
    for place in places:
        dx, dy = free_place(place, SIZE, taken, INSIDE)
        box = (place[0] + dx, place[1] + dy, place[0] + dx + SIZE[0], place[1] + dy + SIZE[1])
        assert not any(overlap(box, other) for other in taken)
        assert box[0] >= 0
        assert box[1] >= 0
        assert box[2] <= 400
        assert box[3] <= 300
        taken.append(box)


def test_alone_a_label_stands_to_the_right_and_at_the_edge_to_the_left() -> None:
    dx, _ = free_place((100.0, 100.0), SIZE, [], INSIDE)
    assert dx > 0
    dx, _ = free_place((395.0, 100.0), SIZE, [], INSIDE)
    assert dx < -SIZE[0]


def test_without_any_room_there_is_a_place_nonetheless() -> None:
    dx, dy = free_place((200.0, 150.0), SIZE, [INSIDE], INSIDE)
    assert abs(dx) < 400
    assert abs(dy) < 300
