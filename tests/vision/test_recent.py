import numpy as np

from rsbench.vision.features import MatchOptions, detect, forget_features
from rsbench.vision.recent import Recent, content_key


def test_the_last_results_are_kept_and_no_more() -> None:
    made = list[int]()

    def make(n: int) -> int:
        made.append(n)
        return 10 * n

    recent = Recent[int](2)
    assert [recent.get(n, lambda n=n: make(n)) for n in (1, 2, 1, 3, 1, 2)] == [10, 20, 10, 30, 10, 20]
    assert made == [1, 2, 3, 2]  # 2 was asked for longest ago when 3 came


def test_images_are_told_apart_by_all_that_they_are() -> None:
    image = np.arange(24, dtype=np.uint8).reshape(4, 6)
    others = (image + np.uint8(1), image.reshape(6, 4), image.view(np.int8))
    assert content_key(image.copy()) == content_key(image)
    assert content_key(np.asfortranarray(image)) == content_key(image)
    assert len({content_key(image), *map(content_key, others)}) == 4


def test_features_are_those_of_the_image_and_the_options_that_are_asked_for() -> None:
    rng = np.random.default_rng(0)
    image = np.asarray(255 * rng.random((60, 80)), dtype=np.uint8)
    found = detect(image)
    assert detect(image.copy()) is found
    forget_features()
    assert detect(image) is not found
    few = detect(image, MatchOptions(max_features=5))
    assert len(few.points) < len(detect(image).points)
    image[:] = 0
    assert len(detect(image).points) == 0
