/* SPDX-License-Identifier: GPL-3.0-or-later
 *
 * Job type for Flamenco 3: frames of a .blend file by `drgs render`, and optionally `drgs denoise` over all of them.
 * Put this file into the Manager's folder `scripts`. The Manager's variable `drgs` names the program, with its whole
 * path: for a name without a path that is not found, a worker would start Blender instead.
 */
const JOB_TYPE = {
    label: "DR-GS Render",
    description: "Render frames with DR-GS, verified and resumable",
    settings: [
        { key: "frames", type: "string", required: true,
          eval: "f'{C.scene.frame_start}-{C.scene.frame_end}'",
          evalInfo: { showLinkButton: true, description: "Frame range of the scene" },
          description: "Frames to render: 1-24, 30" },
        { key: "chunk_size", type: "int32", default: 5, visible: "submission",
          description: "Frames of one task" },
        { key: "render_output_path", type: "string", subtype: "file_path", required: true,
          eval: "str(Path(abspath('//'), 'frames', '####.exr'))",
          description: "EXR files; #### becomes the frame's number" },
        { key: "denoised_output_path", type: "string", subtype: "file_path", required: false, default: "",
          description: "EXR files of a second step that denoises over time; none when empty" },
        { key: "options", type: "string", required: false, default: "",
          description: "Further options of `drgs render`, divided by blanks" },
        { key: "blendfile", type: "string", required: true, visible: "web",
          description: "Path of the Blender file to render" },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    if (!settings.render_output_path) {
        throw "no render_output_path setting!";
    }
    const clean = settings.denoised_output_path;
    const options = words(settings.options);
    const temporal = clean ? ["--denoise", "none", "--passes", "temporal"] : [];
    const chunks = frameChunker(settings.frames, settings.chunk_size);

    const rendered = [];
    for (const chunk of chunks) {
        const out = ["--frames=" + chunk, "--out=" + settings.render_output_path];
        rendered.push(drgsTask("render", chunk, settings.blendfile, out.concat(temporal, options)));
    }
    for (const task of rendered) {
        job.addTask(task);
    }
    if (!clean) {
        return;
    }
    for (const chunk of chunks) {
        const out = ["--frames=" + chunk, "--sequence=" + settings.frames, "--out=" + clean];
        const task = drgsTask("denoise", chunk, settings.render_output_path, out);
        for (const before of rendered) {
            task.addDependency(before);
        }
        job.addTask(task);
    }
}

/* `drgs COMMAND SUBJECT ARGUMENTS`. The command "blender-render" runs `exe argsBefore blendfile args` and looks for the
 * lines `Saved: '...'`, which tell the Manager of finished frames. */
function drgsTask(command, chunk, subject, args) {
    const task = author.Task(command + "-" + chunk, "blender");
    task.addCommand(author.Command("blender-render", {
        exe: "{drgs}",
        argsBefore: [command],
        blendfile: subject,
        args: args,
    }));
    return task;
}

function words(text) {
    return (text || "").split(" ").filter(function (word) { return word.length > 0; });
}
