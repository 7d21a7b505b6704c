//! Vertices of a PLY in another PLY, with all their properties: also those that this workspace knows nothing of.

use super::shift;
use super::table::{self, Column, Table};
use gs_io::{Error, IoContext, Result, write_atomic};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Name of the property that says which instance a Gaussian belongs to.
pub const INSTANCE: &str = "instance";

/// A whole number for each Gaussian, -1 for none, and the name of its property.
pub type IdColumn<'a> = (&'a str, &'a [i32]);

/// The vertices of a PLY, to write some of them.
pub struct Vertices {
    table: Table<'static>,
    path: PathBuf,
    /// That of the file's comments: positions stay as they are, and so does what was subtracted from them.
    shift: [f64; 3],
}

impl Vertices {
    /// Reads them. Lists and other elements are left out.
    ///
    /// # Errors
    /// When the file is damaged or has no vertices.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).at("read", path)?;
        let table = table::read(&bytes).map_err(|e| e.file(path))?.into_owned();
        let shift = shift::of(&bytes).map_err(|e| e.file(path))?;
        Ok(Self { table, path: path.to_path_buf(), shift })
    }

    /// Number of vertices.
    pub fn len(&self) -> usize {
        self.table.count
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Writes the vertices `rows`, in that order, as a little-endian PLY with all scalar properties as they are; those of an
    /// ascii file, or of one with lists, as floats and doubles. `ids` have a number for every vertex that was read, and take the place of
    /// properties of their names that the file has. `comments` become comment lines.
    ///
    /// # Errors
    /// When there are not as many labels as vertices, one of the rows is not there, or the file cannot be written.
    pub fn write(&self, to: impl AsRef<Path>, rows: &[u32], ids: &[IdColumn<'_>], comments: &[String]) -> Result<()> {
        let to = to.as_ref();
        if let Some((_, labels)) = ids.iter().find(|(_, l)| l.len() != self.len()) {
            let e = Error::new("not a label per vertex").file(&self.path);
            return Err(e.found(labels.len()).expected(self.len()));
        }
        if let Some(row) = rows.iter().find(|r| **r as usize >= self.len()) {
            let e = Error::new("no such vertex").file(&self.path);
            return Err(e.found(row).expected(format!("below {}", self.len())));
        }
        write_atomic(to, |w| self.write_rows(w, to, rows, ids, comments))
    }

    fn write_rows(
        &self,
        w: &mut dyn Write,
        to: &Path,
        rows: &[u32],
        ids: &[IdColumn<'_>],
        comments: &[String],
    ) -> Result<()> {
        let kept = |(name, _): &(&str, _)| ids.iter().all(|(id, _)| id != name);
        let columns: Vec<_> = self.table.columns().filter(kept).collect();
        let property = |(name, column): &(&str, Column)| (column.type_name(), (*name).to_string());
        let mut properties: Vec<(&str, String)> = columns.iter().map(property).collect();
        properties.extend(ids.iter().map(|(name, _)| ("int", (*name).to_string())));
        w.write_all(super::header(rows.len(), comments, self.shift, &properties).as_bytes()).at("write", to)?;
        let mut row = Vec::new();
        for &i in rows {
            row.clear();
            columns.iter().for_each(|(_, column)| self.table.put(i as usize, *column, &mut row));
            row.extend(ids.iter().flat_map(|(_, l)| l[i as usize].to_le_bytes()));
            w.write_all(&row).at("write", to)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Gaussians;
    use crate::ply::{read_gaussians, read_labels, write_gaussians};

    /// A PLY of two Gaussians with a normal, a byte, a double and a property of its own, in one encoding.
    fn file(encoding: &str, folder: &Path) -> PathBuf {
        let names = ["x", "y", "z", "nx", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"];
        let names = [&names[..], &["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]].concat();
        let mut header = format!("ply\nformat {encoding} 1.0\ncomment theirs\nelement vertex 2\n");
        names.iter().for_each(|n| header += &format!("property float {n}\n"));
        header += "property uchar segment\nproperty double time\nproperty int instance\nend_header\n";
        let mut bytes = header.into_bytes();
        for i in 0..2u8 {
            let values: Vec<f32> = (0..names.len()).map(|k| k as f32 * 0.5 + f32::from(i)).collect();
            let (segment, time, instance) = (200 + i, 1e9 + f64::from(i) + 0.25, 7i32 + i32::from(i));
            match encoding {
                "ascii" => {
                    let words: Vec<String> = values.iter().map(ToString::to_string).collect();
                    bytes.extend(format!("{} {segment} {time} {instance}\n", words.join(" ")).bytes());
                }
                "binary_little_endian" => {
                    values.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
                    bytes.push(segment);
                    bytes.extend([&time.to_le_bytes()[..], &instance.to_le_bytes()].concat());
                }
                _ => {
                    values.iter().for_each(|v| bytes.extend(v.to_be_bytes()));
                    bytes.push(segment);
                    bytes.extend([&time.to_be_bytes()[..], &instance.to_be_bytes()].concat());
                }
            }
        }
        let path = folder.join(format!("{encoding}.ply"));
        std::fs::write(&path, bytes).unwrap();
        path
    }

    #[test]
    fn all_properties_stay_as_they_are() {
        let dir = tempfile::tempdir().unwrap();
        for encoding in ["binary_little_endian", "binary_big_endian", "ascii"] {
            let (from, to) = (file(encoding, dir.path()), dir.path().join("out.ply"));
            let vertices = Vertices::read(&from).unwrap();
            vertices.write(&to, &[1, 0, 1], &[(INSTANCE, &[-1, 4])], &["mine".into()]).unwrap();
            assert_eq!(read_gaussians(&to).unwrap(), read_gaussians(&from).unwrap().select(&[1, 0, 1]), "{encoding}");
            assert_eq!(read_labels(&to, "segment", [0.0; 3]).unwrap().1, [201, 200, 201]);
            let bytes = std::fs::read(&to).unwrap();
            let header = String::from_utf8_lossy(&bytes[..600]).into_owned();
            assert!(header.contains("comment mine\n") && header.contains(" nx\n"), "{header}");
            assert_eq!(header.matches(" instance\n").count(), 1, "the new one alone");
            // The last four bytes of a row are the label.
            assert_eq!(bytes[bytes.len() - 4..], 4i32.to_le_bytes());
            if encoding != "ascii" {
                assert!(header.contains("property uchar segment\nproperty double time\nproperty int instance\n"));
                let time = bytes.len() - 12..bytes.len() - 4;
                assert_eq!(bytes[time], (1e9 + 1.25f64).to_le_bytes());
            }
            // Without labels the file's own stay.
            vertices.write(&to, &[0], &[], &[]).unwrap();
            assert_eq!(read_labels(&to, "instance", [0.0; 3]).unwrap().1, [7]);
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let (from, to) = (dir.path().join("g.ply"), dir.path().join("out.ply"));
        let g = Gaussians {
            means: vec![[0.0; 3]; 2],
            log_scales: vec![[0.0; 3]; 2],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity_logits: vec![0.0; 2],
            sh: vec![0.0; 6],
            sh_degree: 0,
            ..Gaussians::default()
        };
        write_gaussians(&from, &g, &[]).unwrap();
        let refused = |rows: &[u32], ids: &[IdColumn<'_>]| {
            Vertices::read(&from).unwrap().write(&to, rows, ids, &[]).unwrap_err().to_string()
        };
        assert!(refused(&[0], &[(INSTANCE, &[1])]).contains("not a label per vertex; found 1, expected 2"));
        assert!(refused(&[2], &[]).contains("no such vertex; found 2, expected below 2"));
        assert!(!to.exists());
    }
}
