#!/usr/bin/env python3
"""Runs whole commands of the program on damaged files, and fails if one of them aborts, panics or does not end.

    .cache/python/bin/python tools/damaged-inputs.py [--inputs N] [--seed S] [--only WORD] [PROGRAM]

The files are those that the program itself, pydicom, nibabel, SimpleITK, tifffile and Pillow write. Each input is a copy of one case in
which one file has changed bits, cut or repeated parts, or numbers replaced by extreme ones. A run must end by itself within CPU_S of the
processor and TIMEOUT_S, in ADDRESS_SPACE, with an exit code that the program documents, and without a report of an internal fault.
Inputs that break this are kept in the folder `damaged-inputs`, each with its command.
"""

import argparse
import collections
import concurrent.futures
import gzip
import os
import random
import re
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import SimpleITK
import tifffile
from PIL import Image
from pydicom import encaps, uid
from pydicom.dataset import Dataset, FileMetaDataset

# Time of the processor within which a run ends. The clock says little on a busy machine: its limit is for runs that wait for ever.
CPU_S = 30
TIMEOUT_S = 600
ADDRESS_SPACE = 8 << 30
# Success, a refused input, a refused option, no device, a failure that may pass.
EXIT_CODES = {0, 1, 2, 3, 75}
# Extreme numbers as text, and as little-endian values of 1, 2, 4 and 8 bytes.
NUMBERS = [b"0", b"-1", b"1e400", b"nan", b"-inf", b"4294967296", b"99999999999", b"18446744073709551615", b"1e-300", b"1e20", b"0.5"]
TOKENS = [b"null", b"{", b"]", b'"', b"\0\0\0\0", b"\xff\xff\xff\xff", b"\n", b" ", b"\\", b"<", b"\xe9"]
BINARY = [
    struct.pack(kind, value)
    for kind, values in {
        "<B": (0, 1, 127, 128, 255),
        "<H": (0, 1, 32767, 32768, 65535),
        "<I": (0, 1, 2**31 - 1, 2**31, 2**32 - 1),
        "<Q": (2**63 - 1, 2**64 - 1),
        "<f": (float("nan"), float("inf"), -1e38, 1e-40),
        "<d": (float("nan"), float("inf"), 1e300),
    }.items()
    for value in values
]
# Bytes at the beginning of a file within which most changes are made, because headers are there.
HEAD_BYTES = 800

# A command on a folder of files. `share` is its share of all inputs, in parts; commands that open a Vulkan device have small ones.
Case = collections.namedtuple("Case", "name folder damaged command share")


def xa_run(frame_list):
    """Returns an X-ray angiography run of given frames, uncompressed."""
    frames = np.stack(frame_list)
    d = Dataset()
    d.file_meta = FileMetaDataset()
    d.file_meta.TransferSyntaxUID = uid.ExplicitVRLittleEndian
    d.SOPClassUID = d.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.12.1"
    d.SOPInstanceUID = d.file_meta.MediaStorageSOPInstanceUID = "1.2.3.4"
    d.Modality, d.PhotometricInterpretation = "XA", "MONOCHROME2"
    d.FrameTime, d.PixelIntensityRelationship = 100, "LOG"
    d.PositionerPrimaryAngle, d.PositionerSecondaryAngle = 30, -20
    d.DistanceSourceToDetector, d.DistanceSourceToPatient = 1000, 700
    d.ImagerPixelSpacing = [2.0, 2.0]
    d.NumberOfFrames, d.Rows, d.Columns = frames.shape
    d.SamplesPerPixel, d.PixelRepresentation = 1, 0
    bits = 8 if frames.dtype == np.uint8 else 12
    d.BitsAllocated, d.BitsStored, d.HighBit = 8 * frames.dtype.itemsize, bits, bits - 1
    d.PixelData = frames.tobytes()
    d["PixelData"].VR = "OB" if frames.dtype == np.uint8 else "OW"
    return d


def moving_bar(shape, frames, dtype=np.uint8):
    """Returns frames of a bar that moves in front of a background."""
    rows, columns = np.indices(shape)
    top = 255 if dtype == np.uint8 else 4095
    image = lambda f: np.where(abs(columns - 10 - 2 * f) < 2, 0.35 * top, 0.75 * top + rows * top / 400)
    return [image(f).astype(dtype) for f in range(frames)]


def by_gdcm(frame, compressor, scratch):
    """Returns a frame as GDCM compresses it, and its transfer syntax."""
    writer = SimpleITK.ImageFileWriter()
    writer.SetImageIO("GDCMImageIO")
    writer.UseCompressionOn()
    writer.SetCompressor(compressor)
    writer.SetFileName(str(scratch))
    writer.Execute(SimpleITK.GetImageFromArray(frame[None]))
    written = pydicom.dcmread(scratch)
    return next(encaps.generate_frames(written.PixelData, number_of_frames=1)), written.file_meta.TransferSyntaxUID


def dicom_files(folder):
    """Writes runs in the transfer syntaxes and forms that are read."""
    scratch = folder / "scratch"
    frames = moving_bar((32, 32), 6)
    wide = moving_bar((32, 32), 6, np.uint16)
    save = lambda name, d, **options: d.save_as(folder / f"{name}.dcm", enforce_file_format=True, **options)
    save("explicit", xa_run(frames))
    implicit = xa_run(wide)
    implicit.file_meta.TransferSyntaxUID = uid.ImplicitVRLittleEndian
    save("implicit", implicit)
    rle = xa_run(wide)
    rle.compress(uid.RLELossless)
    save("rle", rle)

    def encapsulated(name, images, encode):
        d = xa_run(images)
        encoded = [encode(image) for image in images]
        d.file_meta.TransferSyntaxUID = encoded[0][1]
        d.PixelData = encaps.encapsulate([data for data, _ in encoded], has_bot=False)
        d["PixelData"].VR = "OB"
        save(name, d)

    def baseline(image):
        Image.fromarray(image).save(scratch, "JPEG")
        return scratch.read_bytes(), uid.JPEGBaseline8Bit

    encapsulated("baseline", frames, baseline)
    # CharLS has encoded this frame.
    jpeg_ls = (Path(__file__).parent.parent / "tests/common/frames/lossless.jls").read_bytes()
    encapsulated("jpeg-ls", moving_bar((24, 32), 6), lambda image: (jpeg_ls, uid.JPEGLSLossless))
    encapsulated("lossless", wide, lambda image: by_gdcm(image, "JPEG", scratch))
    encapsulated("jpeg2000", wide, lambda image: by_gdcm(image, "JPEG2000", scratch))

    def group(**values):
        d = Dataset()
        for name, value in values.items():
            setattr(d, name, value)
        return d

    enhanced = xa_run(frames)
    enhanced.SharedFunctionalGroupsSequence = [
        group(
            XRayGeometrySequence=[group(DistanceSourceToIsocenter=700.0, DistanceSourceToDetector=1000.0)],
            FramePixelDataPropertiesSequence=[group(ImagerPixelSpacing=[2.0, 1.5])],
            PositionerPositionSequence=[group(PositionerPrimaryAngle=30.0, PositionerSecondaryAngle=-20.0)],
        )
    ]
    enhanced.PerFrameFunctionalGroupsSequence = [
        group(FrameContentSequence=[group(FrameReferenceDateTime=f"2026112612000{k}")]) for k in range(6)
    ]
    save("enhanced", enhanced)
    curve = xa_run(frames)
    waveform = group(
        MultiplexGroupTimeOffset=0, NumberOfWaveformChannels=1, NumberOfWaveformSamples=400, SamplingFrequency=400,
        WaveformBitsAllocated=16, WaveformSampleInterpretation="SS",
        ChannelDefinitionSequence=[group(ChannelLabel="ECG II", WaveformBitsStored=16)],
    )
    waveform.WaveformData = (np.arange(400) % 160 < 4).astype("<i2").tobytes()
    waveform["WaveformData"].VR = "OW"
    curve.WaveformSequence = [waveform]
    save("ecg", curve)
    scratch.unlink()
    return sorted(path.name for path in folder.glob("*.dcm"))


def volume_files(folder):
    """Writes a volume in each format that is read."""
    values = np.zeros((16, 16, 16), np.float32)
    values[6:10, 3:13, 7:9] = 0.05
    affine = np.diag([-4.0, -4.0, 4.0, 1.0])
    nibabel.Nifti1Image(values, affine).to_filename(folder / "v.nii")
    nibabel.Nifti1Image(values, affine).to_filename(folder / "w.nii.gz")
    image = SimpleITK.GetImageFromArray(values)
    image.SetSpacing([4.0, 4.0, 4.0])
    for name, compressed in (("v.mha", False), ("w.mha", True), ("v.nrrd", False), ("w.nrrd", True)):
        SimpleITK.WriteImage(image, str(folder / name), compressed)
    np.save(folder / "v.npy", values)
    return sorted(path.name for path in folder.iterdir())


def picture_files(folder):
    """Writes two views as pictures, with their phases and R-peaks."""
    for view in ("png", "jpg"):
        (folder / view).mkdir()
        for f, image in enumerate(moving_bar((24, 32), 4)):
            Image.fromarray(image).save(folder / view / f"frame{f}.{view}")
    tifffile.imwrite(folder / "pages.tif", np.stack(moving_bar((24, 32), 4, np.uint16)), photometric="minisblack")
    (folder / "phases.txt").write_text("0\n1\n2\n3\n")
    (folder / "peaks.txt").write_text("0\n0.4\n0.8\n")
    (folder / "views.toml").write_text(GEOMETRY)
    return ["png/frame1.png", "jpg/frame1.jpg", "pages.tif", "phases.txt", "peaks.txt"]


GEOMETRY = """\
[[view]]
path = "png"
angles_deg = [-30, 20]
sid_mm = 1000
sod_mm = 700
pixel_mm = 4
fps = 10
r_peaks_s = [0, 0.4, 0.8]

[[view]]
path = "pages.tif"
angles_deg = [40.0, -10.0]
sid_mm = 1000
sod_mm = 700
pixel_mm = [4.0, 4.5]
fps = 10
r_peaks_s = [0, 0.4, 0.8]
"""

TREE = """{"branches":[{"name":"a","first":0,"count":3},{"name":"b","first":3,"count":2}],"radius_mm":[5,4.5,4,4,3.5],
"points_mm":[[[0,0,0],[25,0,3],[50,0,6],[25,0,3],[25,30,3]],[[0,13,0],[25,13,3],[50,13,6],[25,13,3],[25,45,3]],
[[0,-13,0],[25,-13,3],[50,-13,6],[25,-13,3],[25,15,3]]]}"""


def ran(program, *words):
    outcome = subprocess.run([program, *map(str, words)], capture_output=True, text=True)
    if outcome.returncode != 0:
        sys.exit(f"the undamaged files are refused: {' '.join(map(str, words))}: {outcome.stderr}")


def cases(program, root):
    """Writes the undamaged files, and returns the commands on them."""
    found = []

    def folder(name):
        path = root / name
        path.mkdir()
        return path

    def case(name, files, *command, share=10):
        damaged, where = files
        found.append(Case(name, where, damaged, command, share))

    phantom = ["--size", 16, "--phases", 3, "--views", 3, "--test-angles", "10,10"]
    native = folder("native")
    ran(program, "phantom", native / "data", *phantom)
    names = lambda path, at: [str(p.relative_to(path)) for p in sorted((path / at).rglob("*")) if p.is_file()]
    manifest = ["data/dataset.json"]
    all_files = names(native, "data")
    for name, command in {"check": ["check", "data", "--json"], "convert": ["convert", "data", "--layout", "nerfca", "-o", "out"],
                          "info": ["info", "data", "--picture", "out.png"], "calibrate": ["calibrate", "data", "-o", "out"]}.items():
        case(f"{name} of a manifest", (manifest, native), *command)
        case(f"{name} of any file", (all_files, native), *command, share=4)
    author = folder("nerfca")
    ran(program, "phantom", author / "data", *phantom, "--layout", "nerfca")
    case("check of the authors' layout", (names(author, "data"), author), "check", "data")
    case("convert of the authors' layout", (names(author, "data"), author), "convert", "data", "--layout", "native", "-o", "out")

    dicom = folder("dicom")
    for name in dicom_files(dicom):
        more = ["--phase-list", "list.txt", "--phases", 3] if name != "ecg.dcm" else ["--phases", 3]
        (dicom / "list.txt").write_text("0\n1\n2\n0\n1\n2\n")
        ran(program, "import", "dicom", dicom / name, "--phases", 3, "-o", root / "out", "--force",
            *(["--phase-list", dicom / "list.txt"] if name != "ecg.dcm" else []))
        case(f"import dicom {name}", ([name], dicom), "import", "dicom", name, *more, "-o", "out", share=12)
    still = ["explicit.dcm", "rle.dcm"]
    case("import dicom --still", (still, dicom), "import", "dicom", *still, "--still", "-o", "out")

    pictures = folder("pictures")
    files = picture_files(pictures)
    stated = ["--sid", 1000, "--sod", 700, "--pixel", 4, "--angles", "-30,20;40,-10;0,0", "--fps", 10, "--phases", 4]
    views = ["png", "jpg", "pages.tif"]
    by_options = ["import", "pictures", *views, *stated, "-o", "out"]
    by_file = ["import", "pictures", "--geometry", "views.toml", "--phases", 4, "-o", "out"]
    case("import pictures by list", (files, pictures), *by_options, "--phase-list", "phases.txt", share=20)
    case("import pictures by peaks", (files, pictures), *by_options, "--r-peaks", "peaks.txt")
    case("import pictures by a file", (["views.toml"], pictures), *by_file)

    # From here on, each command opens a device.
    volumes = folder("volumes")
    shapes = {"v.npy": ["--spacing", "4,4,4"]}
    for name in volume_files(volumes):
        case(f"project {name}", ([name], volumes), "project", name, "--still", "--centre", *shapes.get(name, []), "--size", 16,
             "--vessel", 0.02, "-o", "out", share=3)
    trees = folder("trees")
    (trees / "t.json").write_text(TREE)
    ran(program, "phantom", trees / "data", "--tree", trees / "t.json", "--centre", "--size", 32, *phantom[2:])
    ran(program, "train", trees / "data", "-o", trees / "run", "--set", "train.iterations=150")
    ran(program, "tree", trees / "run", "-o", trees / "t.vtp")
    vtp = sorted(path.name for path in trees.glob("*.vtp"))[0]
    for name in ("t.json", vtp):
        case(f"phantom --tree {name}", ([name], trees), "phantom", "out", "--tree", name, "--centre", "--size", 16, "--phases", 2, share=4)
    shutil.rmtree(trees / "run" / "report")
    (trees / "run" / "report.html").unlink()
    runs = [name for name in names(trees, "run") if name.endswith((".safetensors", ".json", ".toml"))]
    case("info of a run", (runs, trees), "info", "run", share=4)
    case("tree", (runs, trees), "tree", "run", "-o", "out.json", share=4)
    case("eval", (runs + ["data/dataset.json"], trees), "eval", "run", "--data", "data", share=4)
    case("export", (runs, trees), "export", "run", "--spacing", 4, "-o", "out.nrrd", share=2)
    settings = ["--config", "config.toml", "--print-config"]
    case("train --print-config", (["config.toml"], trees), "train", "data", "-o", "out", *settings, share=4)
    case("study list", (["smoke.toml"], trees), "study", "list", "smoke.toml", share=4)
    made = subprocess.run([program, "train", trees / "data", "--print-config"], capture_output=True, check=True).stdout
    (trees / "config.toml").write_bytes(made)
    shutil.copytree(Path(__file__).parent.parent / "studies", trees, dirs_exist_ok=True)
    return found


def damaged_once(data, rng):
    """Returns bytes with one change."""
    reach = len(data) if rng.random() < 0.3 else min(len(data), HEAD_BYTES)
    at = rng.randrange(reach) if reach else 0
    end = min(len(data), at + rng.randrange(1, 80))
    kind = rng.randrange(9)
    if kind == 0:
        return data[:at]
    if kind == 1 and data:
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == 2:
        return data[:at] + data[end:]
    if kind == 3:
        to = rng.randrange(len(data) + 1)
        return data[:to] + data[at:end] * rng.choice((1, 1, 2, 50)) + data[to:]
    if kind == 4:
        return data[:at] + rng.choice(TOKENS) + data[at:]
    if kind in (5, 6):
        numbers = list(re.finditer(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?", data[: max(reach, 1)]))
        if numbers:
            match = rng.choice(numbers)
            return data[: match.start()] + rng.choice(NUMBERS) + data[match.end() :]
    value = rng.choice(BINARY)
    if rng.random() < 0.5:
        at -= at % len(value)
    return data[:at] + value + data[at + len(value) :]


def damaged(data, rng):
    """Returns a damaged copy of a file; compressed ones are also damaged beneath their compression."""
    zipped = data[:2] == b"\x1f\x8b" and rng.random() < 0.6
    if zipped:
        data = gzip.decompress(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = damaged_once(data, rng)
    return gzip.compress(data, 1) if zipped else data


def limited():
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, 1 << 30))


def fault_of(command, directory):
    """Runs a command, and returns its exit code and its fault, which is empty if there is none."""
    # One thread for each command, since as many commands run at once as there are processors.
    environment = os.environ | {"RAYON_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}
    try:
        run = subprocess.run(command, cwd=directory, capture_output=True, timeout=TIMEOUT_S, preexec_fn=limited, env=environment)
    except subprocess.TimeoutExpired:
        return None, f"did not end within {TIMEOUT_S} s"
    said = run.stderr.decode(errors="replace")
    if run.returncode not in EXIT_CODES:
        return run.returncode, f"exit code {run.returncode}: {said[-400:]}"
    if "panicked at" in said or "internal fault" in said:
        return run.returncode, said[-400:]
    return run.returncode, ""


def one(program, case, seed, scratch, kept):
    """Runs a case on a damaged copy of its files, and returns its exit code and its fault."""
    rng = random.Random(seed)
    directory = Path(tempfile.mkdtemp(dir=scratch))
    try:
        shutil.copytree(case.folder, directory, dirs_exist_ok=True)
        name = rng.choice(case.damaged)
        path = directory / name
        path.write_bytes(damaged(path.read_bytes(), rng))
        command = [program, *map(str, case.command)]
        code, fault = fault_of(command, directory)
        if fault:
            shutil.rmtree(kept / str(seed), ignore_errors=True)
            shutil.copytree(directory, kept / str(seed), ignore=shutil.ignore_patterns("out"))
            (kept / str(seed) / "COMMAND").write_text(f"{' '.join(command)}\n{name}\n{fault}\n")
        return code, fault
    finally:
        shutil.rmtree(directory, ignore_errors=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=2000, help="number of damaged inputs")
    parser.add_argument("--seed", type=int, default=1, help="number of the first input")
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="number of commands at once")
    parser.add_argument("program", nargs="?", default="target/release/nertca-vk", help="the program")
    options = parser.parse_args()
    program = str(Path(options.program).resolve())
    kept = Path("damaged-inputs").resolve()
    kept.mkdir(exist_ok=True)
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=memory) as root:
        found = [case for case in cases(program, Path(root)) if options.only in case.name]
        for case in found:
            directory = Path(tempfile.mkdtemp(dir=root))
            shutil.copytree(case.folder, directory, dirs_exist_ok=True)
            code, fault = fault_of([program, *map(str, case.command)], directory)
            if code != 0 and not case.name.startswith(("check", "calibrate", "import dicom --still")):
                sys.exit(f"{case.name}: the undamaged files give exit code {code}: {fault}")
            shutil.rmtree(directory)
        seeds = range(options.seed, options.seed + options.inputs)
        shares = [case.share for case in found]
        chosen = [random.Random(seed).choices(found, shares)[0] for seed in seeds]
        codes, faults = collections.Counter(), 0
        with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
            results = pool.map(lambda job: one(program, *job, root, kept), zip(chosen, seeds))
            for number, (case, seed, (code, fault)) in enumerate(zip(chosen, seeds, results), 1):
                codes[case.name.split()[0], code] += 1
                if fault:
                    faults += 1
                    print(f"input {seed}, {case.name}: {fault}", flush=True)
                if number % 1000 == 0:
                    print(f"{number} inputs, {faults} faults", flush=True)
    for (command, code), count in sorted(codes.items(), key=str):
        print(f"{command}: exit code {code}: {count}")
    print(f"{options.inputs} inputs, {faults} faults{f', kept in {kept}' if faults else ''}")
    sys.exit(faults > 0)


if __name__ == "__main__":
    main()
