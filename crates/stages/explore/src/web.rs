//! The files of the page, as they lie in `web/`.

/// A file of the page.
pub struct File {
    /// Its name in `web/`.
    pub name: &'static str,
    /// Its content.
    pub text: &'static str,
}

/// The page itself.
pub const INDEX: &str = include_str!("../web/index.html");
/// Its style.
pub const STYLE: &str = include_str!("../web/style.css");

macro_rules! modules {
    ($($name:literal),*) => { [$(File { name: $name, text: include_str!(concat!("../web/", $name)) }),*] };
}

/// The modules, each after those that it imports.
pub const MODULES: [File; 8] =
    modules!["maths.js", "gaussians.js", "sort.js", "viewer.js", "camera.js", "instances.js", "doors.js", "main.js"];

/// All modules as one: import lines go, so does `export`. Names at the top of the modules must differ.
pub fn bundle() -> String {
    let mut out = String::new();
    for module in MODULES {
        for line in module.text.lines().filter(|l| !l.starts_with("import ")) {
            out += line.strip_prefix("export ").unwrap_or(line);
            out.push('\n');
        }
    }
    out
}
