// Flamenco 3: a job type. Put this file into the folder scripts beside flamenco-manager.
const JOB_TYPE = {
  label: "jaxdn denoise",
  settings: [
    { key: "input", type: "string", subtype: "dir_path", required: true },
    { key: "output", type: "string", subtype: "dir_path", required: true },
    { key: "frames", type: "string", default: "1-400", required: true },
    { key: "chunk_size", type: "int32", default: 200 },
    { key: "method", type: "string", default: "auto" },
  ],
};

function compileJob(job) {
  const s = job.settings;
  for (const chunk of frameChunker(s.frames, s.chunk_size)) {
    const task = author.Task(`denoise-${chunk}`, "misc");
    const frames = ["--frames", ...chunk.split(",")];
    const args = ["denoise", s.input, "-o", s.output, "--method", s.method, ...frames, "--skip-existing"];
    task.addCommand(author.Command("exec", { exe: "jaxdn", args: args }));
    job.addTask(task);
  }
}
