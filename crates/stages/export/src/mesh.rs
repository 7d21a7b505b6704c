//! Triangle meshes and their files.

use gs_io::{IoContext, Result, write_atomic};
use gs_scene::ply;
use std::collections::BTreeSet;
use std::io::Write;
use std::path::Path;

/// A mesh of triangles, corners counter-clockwise seen from outside.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Corners, in units of the scene.
    pub vertices: Vec<[f32; 3]>,
    /// Triangles, as positions in `vertices`.
    pub triangles: Vec<[u32; 3]>,
}

/// What of a mesh's corners is written as it is in the world: a coordinate less a shift, plus that shift.
fn in_world(v: f32, shift: f64) -> String {
    if shift == 0.0 { format!("{v:?}") } else { format!("{:?}", f64::from(v) + shift) }
}

impl Mesh {
    /// Volume that it encloses, cubic units; negative where it is inside out.
    pub fn volume(&self) -> f64 {
        // From its first corner, so that a scene far from the origin loses no digits.
        let Some(first) = self.vertices.first() else { return 0.0 };
        let corner = |i: u32| -> [f64; 3] {
            std::array::from_fn(|c| f64::from(self.vertices[i as usize][c]) - f64::from(first[c]))
        };
        let of = |t: &[u32; 3]| {
            let [a, b, c] = t.map(corner);
            let cross = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
            (a[0] * cross[0] + a[1] * cross[1] + a[2] * cross[2]) / 6.0
        };
        self.triangles.iter().map(of).sum()
    }

    /// Whether it is closed: each edge has one triangle on each side, and all corners, edges and triangles make up one ball.
    pub fn is_closed(&self) -> bool {
        let edges = || self.triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
        let directed: BTreeSet<(u32, u32)> = edges().collect();
        let each_once = directed.len() == 3 * self.triangles.len() && edges().all(|(a, b)| a != b);
        let used: BTreeSet<u32> = self.triangles.iter().flatten().copied().collect();
        let euler = used.len() as i64 - directed.len() as i64 / 2 + self.triangles.len() as i64;
        each_once && directed.iter().all(|&(a, b)| directed.contains(&(b, a))) && euler == 2
    }

    /// Writes Wavefront OBJ, which has numbers of any length: `shift` is added to the corners.
    pub fn write_obj(&self, path: &Path, name: &str, shift: [f64; 3]) -> Result<()> {
        write_atomic(path, |w| {
            let mut text = format!("o {name}\n");
            for p in &self.vertices {
                let [x, y, z] = [0, 1, 2].map(|c| in_world(p[c], shift[c]));
                text += &format!("v {x} {y} {z}\n");
            }
            // OBJ counts from 1.
            self.triangles.iter().for_each(|t| text += &format!("f {} {} {}\n", t[0] + 1, t[1] + 1, t[2] + 1));
            w.write_all(text.as_bytes()).at("write", path)
        })
    }

    /// Writes a little-endian PLY; a comment says what was subtracted from the corners.
    pub fn write_ply(&self, path: &Path, shift: [f64; 3]) -> Result<()> {
        write_atomic(path, |w: &mut dyn Write| {
            let (vertices, faces) = (self.vertices.len(), self.triangles.len());
            let shift = ply::shift_comment(shift).map_or(String::new(), |shift| format!("comment {shift}\n"));
            let header = format!(
                "ply\nformat binary_little_endian 1.0\n{shift}element vertex {vertices}\nproperty float x\nproperty float y\n\
                 property float z\nelement face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
            );
            let mut bytes = header.into_bytes();
            bytes.extend(self.vertices.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
            for t in &self.triangles {
                bytes.push(3);
                bytes.extend(t.iter().flat_map(|i| i.to_le_bytes()));
            }
            w.write_all(&bytes).at("write", path)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tetrahedron with its corner at `at`.
    fn tetrahedron(at: f32) -> Mesh {
        Mesh {
            vertices: [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]]
                .map(|p: [f32; 3]| p.map(|v| v + at))
                .to_vec(),
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        }
    }

    #[test]
    fn volume_and_closedness_of_a_tetrahedron() {
        for at in [0.0, 4096.0] {
            assert!((tetrahedron(at).volume() - 1.0).abs() < 1e-9);
        }
        assert!(tetrahedron(0.0).is_closed());
        let mut open = tetrahedron(0.0);
        open.triangles.pop();
        assert!(!open.is_closed());
        let mut turned = tetrahedron(0.0);
        turned.triangles[0] = [0, 1, 2];
        assert!(!turned.is_closed());
        let mut inside_out = tetrahedron(0.0);
        inside_out.triangles.iter_mut().for_each(|t| t.reverse());
        assert!(inside_out.is_closed() && inside_out.volume() < 0.0);
        let mut two = tetrahedron(0.0);
        two.vertices.extend(tetrahedron(9.0).vertices);
        two.triangles.extend(tetrahedron(9.0).triangles.iter().map(|t| t.map(|i| i + 4)));
        assert!(!two.is_closed(), "two balls are not one");
        assert!(!Mesh::default().is_closed());
    }

    #[test]
    fn files_hold_the_mesh() {
        let dir = tempfile::tempdir().unwrap();
        let (obj, ply) = (dir.path().join("m.obj"), dir.path().join("m.ply"));
        tetrahedron(0.5).write_obj(&obj, "thing", [0.0; 3]).unwrap();
        let text = std::fs::read_to_string(&obj).unwrap();
        assert!(text.starts_with("o thing\nv 0.5 0.5 0.5\nv 1.5 0.5 0.5\n"), "{text}");
        assert!(text.ends_with("f 2 3 4\n"), "{text}");
        tetrahedron(0.5).write_ply(&ply, [0.0; 3]).unwrap();
        // The faces are walked through by the reader, which wants all of them to be there.
        let points = ply::read_points(&ply).unwrap();
        assert_eq!(points.positions, tetrahedron(0.5).vertices);
        let far = [448_262.0, 5_411_932.0, -114.0];
        tetrahedron(0.5).write_obj(&obj, "thing", far).unwrap();
        let text = std::fs::read_to_string(&obj).unwrap();
        assert!(text.starts_with("o thing\nv 448262.5 5411932.5 -113.5\n"), "{text}");
        tetrahedron(0.5).write_ply(&ply, far).unwrap();
        let points = ply::read_points(&ply).unwrap();
        assert_eq!((points.positions, points.shift), (tetrahedron(0.5).vertices, far));
    }
}
