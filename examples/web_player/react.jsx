// The web player as a React 19 component. docs/guide/player.md says how to export a bundle.

import { useRef, useState } from "react";
import "egs-player";

export function Creature({ file, title }) {
  const player = useRef(null);
  const [time, setTime] = useState(0);
  const replay = () => {
    player.current.currentTime = 0;
    player.current.play();
  };
  return (
    <figure>
      <egs-player ref={player} src={file} loop controls ontimeupdate={() => setTime(player.current.currentTime)} />
      <figcaption>
        {title}, {time.toFixed(2)} s <button onClick={replay}>From the start</button>
      </figcaption>
    </figure>
  );
}
