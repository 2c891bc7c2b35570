"""Pictures that are encoded again: motion stays motion, and colours stay what they are, whatever the codec was."""

import json

import av
import cv2
import numpy as np
import pytest
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from .data_recording import TOP, column, last_line, run

HEIGHT, WIDTH, STEPS, FPS = 96, 128, 33, 30
CODECS = ("libsvtav1", "h264", "hevc")
FROZEN = 0.25  # of the change that the source has there
DELTA_RECIPE = "steps: [{filter: {threshold: 0.01}}, {delta: {}}, {resize: {size: [48, 64]}}, {label: {all: true}}]"


def film(steps=STEPS, speed=0.4, noise=5):
    """(T, H, W, 3) uint8: a pattern that moves by a part of a pixel at each step, seen by a camera that is noisy."""
    rng = np.random.default_rng(0)
    grey, colour = (rng.normal(size=(2 * HEIGHT, 3 * WIDTH, n)).astype(np.float32) for n in (1, 3))
    pattern = 110 + 400 * cv2.GaussianBlur(grey, (0, 0), 3)[..., None] + 100 * cv2.GaussianBlur(colour, (0, 0), 3)
    shifts = (np.float32([[1, 0, -20 - speed * i], [0, 1, -20 - 0.4 * speed * i]]) for i in range(steps))
    seen = np.stack([cv2.warpAffine(pattern, shift, (WIDTH, HEIGHT)) for shift in shifts])
    return np.clip(seen + rng.normal(0, noise, seen.shape), 0, 255).astype(np.uint8)


def record(root, pictures, codec="libsvtav1", still=1, **encoder):
    """A recording of one episode whose arm stands still at first, then moves at every step."""
    vector = {"dtype": "float32", "shape": (2,), "names": ["pan.pos", "gripper.pos"]}
    camera = {"dtype": "video", "shape": pictures.shape[1:], "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        "local/src", FPS, {"observation.state": vector, "action": vector, TOP: camera}, root=root,
        rgb_encoder=RGBEncoderConfig(vcodec=codec, **encoder),
    )  # fmt: skip
    for step, picture in enumerate(pictures):
        rest = still if isinstance(still, int) else still[step]  # steps so far in which the arm stood still
        state = np.array([0.1 * max(step - rest, 0), 0], np.float32)
        dataset.add_frame({"observation.state": state, "action": state + np.float32(0.05), TOP: picture, "task": "go"})
    dataset.save_episode()
    dataset.finalize()
    return root


def seen(root):
    """(T, H, W, 3) pictures of a dataset, as LeRobot's decoder gives them."""
    with av.open(str(next((root / "videos").rglob("*.mp4")))) as container:
        return np.stack([f.to_ndarray(format="rgb24") for f in container.decode(video=0)]).astype(np.float32)


def brightness(pictures):
    """Mean grey level, of 255."""
    return float(pictures.mean(axis=(0, 1, 2)) @ [0.299, 0.587, 0.114])


def changes(pictures):
    return np.abs(np.diff(pictures, axis=0)).mean(axis=(1, 2, 3))


def tagged(root, pictures, **options):
    """Encode the recording's pictures anew with FFmpeg's x264, with what the numbers mean written beside them."""
    path = next((root / "videos").rglob("*.mp4"))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", FPS, options={"crf": "5", "g": "10"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, options.pop("pix_fmt", "yuv420p")
        for name, value in options.items():
            setattr(stream.codec_context, name, value)
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(stream.encode())
    return path


def small(pictures):
    return np.stack([cv2.resize(p, (64, 48), interpolation=cv2.INTER_AREA) for p in pictures])


@pytest.fixture(scope="module", params=CODECS)
def moving(request, tmp_path_factory):
    return record(tmp_path_factory.mktemp("film") / request.param, film(), request.param)


@pytest.mark.parametrize(
    ("operation", "scaled"),
    [
        (["filter", "--threshold=0.01"], False),
        (["trim", "--head=1"], False),
        (["resample", "--fps=15"], False),
        (["resample", "--fps=10"], False),
        (["resize", "--size=[48,64]"], True),
        (["run"], True),
    ],
    ids=lambda value: "_".join(value) if isinstance(value, list) else "",
)
def test_slow_motion_does_not_stand_still(moving, tmp_path, operation, scaled):
    (tmp_path / "mine.yaml").write_text(DELTA_RECIPE)
    recipe = [str(tmp_path / "mine.yaml")] if operation[0] == "run" else ()
    run(operation[0], moving, tmp_path / "dst", *operation[1:], recipe=recipe)
    kept = column(tmp_path / "dst", "source.frame_index")
    assert 0 < len(kept) <= STEPS
    wanted, got = seen(moving)[kept], seen(tmp_path / "dst")
    wanted = small(wanted) if scaled else wanted
    assert got.shape == wanted.shape
    assert (changes(got) < FROZEN * changes(wanted)).sum() == 0
    assert np.abs(got - wanted).mean() < 12
    assert abs(brightness(got) - brightness(wanted)) < 0.6


@pytest.mark.parametrize("g", [2, 5, 30])
@pytest.mark.parametrize("seed", range(3))
def test_whatever_is_cut_out_of_av1_the_rest_is_the_source_wherever_it_can_be(tmp_path, seed, g):
    """Pictures whose bytes are taken over are the source's to the last bit; read one by one as well, in any order."""
    steps, rng = 60, np.random.default_rng(seed)
    still = rng.random(steps) < 0.15
    root = record(tmp_path / "src", film(steps=steps), still=np.cumsum(still), g=g)
    run("filter", root, tmp_path / "dst", "--threshold=0.01")
    kept = column(tmp_path / "dst", "source.frame_index")
    assert 0 < len(kept) < steps
    wanted, got = seen(root)[kept], seen(tmp_path / "dst")
    differences = np.abs(got - wanted).mean(axis=(1, 2, 3))
    assert (changes(got) < FROZEN * changes(wanted)).sum() == 0
    assert differences.max() < 8
    # A picture follows the one before it in the source, back to a key frame, or was encoded anew.
    whole = [all(frame - back in kept for back in range(frame % g + 1)) for frame in kept]
    np.testing.assert_array_equal(differences == 0, whole)
    assert sum(whole) > (5 if g < 30 else 0)
    dataset = LeRobotDataset("local/dst", root=tmp_path / "dst")
    for row in rng.permutation(len(kept))[:15]:
        picture = 255 * np.asarray(dataset[int(row)][TOP]).transpose(1, 2, 0)
        np.testing.assert_allclose(picture, got[row], atol=1.01)


def test_a_damaged_video_is_one_line_on_the_terminal(tmp_path, command):
    """Decoders would add their own, which nobody can read."""
    root = record(tmp_path / "src", film())
    path = next((root / "videos").rglob("*.mp4"))
    data = bytearray(path.read_bytes())
    for place in range(len(data) // 3, 2 * len(data) // 3, 37):
        data[place] ^= 0xFF
    path.write_bytes(data)
    names = ["--repo_id=local/src", f"--root={root}", "--new_repo_id=local/dst", f"--new_root={tmp_path / 'dst'}"]
    (line,) = command("cqn-data", "trim", *names, "--head=1", code=2).stderr.strip().splitlines()
    assert line.startswith(f"cqn-data trim: error: Video {path} cannot be read at episode 0, frame ")


def test_a_quality_that_is_asked_for_is_that_of_every_picture(tmp_path):
    root = record(tmp_path / "src", film(), crf=10)
    run("trim", root, tmp_path / "dst", "--head=2", "--crf=50")
    wanted, got = seen(root)[2:], seen(tmp_path / "dst")
    assert (np.abs(got - wanted).mean(axis=(1, 2, 3)) > 0).all()


def test_slow_motion_of_a_film_whose_quality_nobody_wrote_down_stays(tmp_path):
    root = record(tmp_path / "src", film(), "h264", crf=5, g=30)
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    for name in ("video.g", "video.crf", "video.preset"):
        info["features"][TOP]["info"].pop(name, None)
    path.write_text(json.dumps(info))
    run("trim", root, tmp_path / "dst", "--head=1")
    kept = column(tmp_path / "dst", "source.frame_index")
    assert (changes(seen(tmp_path / "dst")) < FROZEN * changes(seen(root)[kept])).sum() == 0


def test_a_film_in_a_codec_that_cannot_be_encoded_here_becomes_key_frames(tmp_path):
    """What is said of it is true, and of another codec: nothing of it is encoded as it was."""
    root = record(tmp_path / "src", film(), "h264", crf=5, g=30)
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"][TOP]["info"]["video.codec"] = "vp9"
    path.write_text(json.dumps(info))
    run("trim", root, tmp_path / "dst", "--head=1")
    with av.open(str(next((tmp_path / "dst/videos").rglob("*.mp4")))) as container:
        assert all(frame.key_frame for frame in container.decode(video=0))


@pytest.mark.parametrize("codec", CODECS)
def test_ten_generations_leave_colours_and_motion(tmp_path, codec):
    record(tmp_path / "0", film(steps=22), codec)
    wanted = seen(tmp_path / "0")[10:]
    for generation in range(10):
        run("trim", tmp_path / str(generation), tmp_path / str(generation + 1), "--head=1")
    got = seen(tmp_path / "10")
    assert abs(brightness(got) - brightness(wanted)) < 2
    assert (changes(got) < FROZEN * changes(wanted)).sum() == 0


@pytest.mark.parametrize(
    "options",
    [
        {"color_range": 2, "colorspace": 1, "color_primaries": 1, "color_trc": 1},
        {"color_range": 1, "colorspace": 5, "color_primaries": 5, "color_trc": 6},
        {"pix_fmt": "yuvj420p"},
        {"pix_fmt": "yuv444p"},
        {"pix_fmt": "yuv420p10le"},
    ],
    ids=["full_709", "limited_601", "jpeg", "444", "10_bits"],
)
@pytest.mark.parametrize(
    "operation", [["trim", "--head=1"], ["resize", "--size=[48,64]", '--crop={"top":[3,5,81,93]}']]
)
def test_what_the_numbers_of_a_video_mean_travels_with_them(tmp_path, operation, options):
    root = record(tmp_path / "src", film(steps=8), "h264", g=10)
    path = tagged(root, film(steps=8), **options)
    run(operation[0], root, tmp_path / "dst", *operation[1:])
    with av.open(str(path)) as old, av.open(str(next((tmp_path / "dst/videos").rglob("*.mp4")))) as new:
        before, after = old.streams.video[0].codec_context, new.streams.video[0].codec_context
        if before.pix_fmt != "yuvj420p":  # of which the new file has the plain kind, limited
            assert (after.color_range, after.colorspace) == (before.color_range, before.colorspace)
            assert (after.color_primaries, after.color_trc) == (before.color_primaries, before.color_trc)
    wanted, got = seen(root), seen(tmp_path / "dst")
    if operation[0] == "trim":
        wanted = wanted[1:]
    else:
        wanted = np.stack([cv2.resize(p[3:84, 5:98], (64, 48), interpolation=cv2.INTER_AREA) for p in wanted])
    other = options.get("pix_fmt", "yuv420p") in ("yuv444p", "yuv420p10le")  # FFmpeg rounds these otherwise to RGB
    np.testing.assert_allclose(got.mean(axis=(0, 1, 2)), wanted.mean(axis=(0, 1, 2)), atol=2 if other else 1.5)
    assert np.abs(got - wanted).mean() < 12


def test_a_video_of_another_size_or_colour_than_it_should_have_is_named(tmp_path, capsys):
    root = record(tmp_path / "src", film(steps=8), "h264")
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"][TOP]["shape"] = [90, WIDTH, 3]
    path.write_text(json.dumps(info))
    for number, operation in enumerate((["trim", "--head=1"], ["resize", "--size=[32,32]"], ["label", "--all"])):
        run(operation[0], root, tmp_path / str(number), *operation[1:], code=2)
        said = last_line(capsys)
        assert "96x128" in said
        assert "90x128" in said
        assert TOP in said
