"""Run `manip-il data to-mcap`, `from-mcap`: convert datasets."""

from manip_il.bridges.mcap.export import export_dataset, left_out
from manip_il.bridges.mcap.importing import import_files, list_files
from manip_il.bridges.mcap.mapping import load_mapping
from manip_il.cli.outputs import prepare_output, progress, save_options, say
from manip_il.cli.transfer import McapExportOptions, McapImportOptions
from manip_il.data.atomic import new_folder, output_of
from manip_il.data.dataset import Dataset


def run_to_mcap(options: McapExportOptions) -> None:
    """Export every episode; the folder appears when it is complete."""
    dataset = Dataset.open(options.dataset)
    prepare_output(
        {options.out: output_of("McapExport")},
        overwrite=options.overwrite,
        sources=[options.dataset],
    )
    with new_folder(options.out) as folder, progress(dataset.info.episodes, "export") as bar:
        for _ in export_dataset(dataset, folder):
            bar.step()
        save_options(folder, options)
    if missing := left_out(dataset.info):
        say(f"left out, because MCAP cannot hold them: {', '.join(missing)}")
    say(f"exported {dataset.info.episodes:,} episodes to {options.out}")


def run_from_mcap(options: McapImportOptions) -> None:
    """Import every file; the dataset appears when it is complete."""
    paths = list_files(options.source)
    with progress(len(paths), "import") as bar:
        info = import_files(paths, options.dataset, load_mapping(options.mapping), bar.step)
    say(f"imported {info.episodes:,} episodes, {info.frames:,} frames to {options.dataset}")
